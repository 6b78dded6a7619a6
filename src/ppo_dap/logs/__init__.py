"""D_off, the logged trajectories: reading, checking, splitting and writing them. Knows nothing of learning."""

from ppo_dap.logs.check import check_logs, require_compatible
from ppo_dap.logs.coverage import best_episodes
from ppo_dap.logs.dataset import Logs, LogsWarning
from ppo_dap.logs.finding import Finding, Report
from ppo_dap.logs.formats import load_logs, sample_names
from ppo_dap.logs.npz import save_npz
from ppo_dap.logs.report import write_report
from ppo_dap.logs.writing import save_minari

__all__ = [
    "Finding",
    "Logs",
    "LogsWarning",
    "Report",
    "best_episodes",
    "check_logs",
    "load_logs",
    "require_compatible",
    "sample_names",
    "save_minari",
    "save_npz",
    "write_report",
]
