"""The kinds of priors: which network stands for which name."""

from __future__ import annotations

from typing import Any

from ppo_dap.priors.diffusion import Denoiser
from ppo_dap.priors.retrieval import Memory
from ppo_dap.priors.uniform import Uniform

NETWORKS: dict[str, Any] = {"diffusion": Denoiser, "retrieval": Memory, "random": Uniform}
"""Kind of prior -> its network; the settings of each are in `prior_config.PRIOR_CONFIGS`."""
