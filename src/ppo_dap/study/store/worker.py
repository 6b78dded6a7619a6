"""What a worker does with a cell: claim it, make it or go on with it, say how that ended.

`python -m ppo_dap.study.store.worker STORE CELL CLAIM` does it in a process of its own, which is one run's one core.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ppo_dap.errors import PPODAPError
from ppo_dap.storage import write_atomically
from ppo_dap.study.store.claims import BEAT, Heart, take
from ppo_dap.study.store.store import Store

DONE, FAILED, TAKEN, STOPPED, LOST = 0, 1, 3, 4, 5
"""How a worker ends: made it; could not; another has it; asked to stop; taken for dead, or left alone."""

Make = Callable[[Mapping[str, Any], Path, Mapping[str, Path]], None]
"""Makes a cell: (what `Store.read` gave, where to, where each need's `out` is). After a kill it is called again, and
goes on."""


class Stopped(Exception):
    """Asked to stop; what was made so far is kept."""


def work(store: Store, name: str, number: int, make: Make, beat: float = BEAT) -> int:
    """Claim the cell under `number` and make it; returns one of the codes above. Errors of `make` are noted."""
    claim = take(store.folder(name), number)
    if claim is None:
        return TAKEN
    if store.done(name):
        claim.remove()
        return DONE
    start = time.perf_counter()

    def note(**how: Any) -> None:
        store.note(name, **how, seconds=round(time.perf_counter() - start, 3), peak_mib=round(peak_mib(), 1))

    with Heart(claim, lambda: os._exit(LOST), beat):
        try:
            cell = store.read(name)
            make(cell, store.out(name), {role: store.out(need) for role, need in cell["needs"].items()})
        except (Stopped, KeyboardInterrupt):
            note(end="stopped")
            claim.release()
            return STOPPED
        except Exception as error:
            print(told(error), file=sys.stderr)
            try:
                note(end="failed", error=told(error))
                claim.release()
            except OSError:  # the disk is full: the claim ends with the process, and the caller has read our last line
                pass
            return FAILED
        note(end="done")
        store.finish(name)
    claim.remove()
    return DONE


def peak_mib() -> float:
    """Most memory that this process has had, in MiB."""
    try:  # Linux counts the process that started this one into ru_maxrss
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 2**10
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def told(error: BaseException) -> str:
    """An error in one line."""
    lines = str(error).strip().splitlines() or [""]
    return lines[-1] if isinstance(error, PPODAPError) else f"{type(error).__name__}: {lines[-1]}"


def make_cell(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    """Make a cell of a study for good. Raises what the functions that it calls do."""
    from ppo_dap.training.manifest import prepare_jax

    prepare_jax()
    {"behaviour": _behaviour, "logs": _logs, "prior": _prior, "run": _run, "reliability": _reliability}[cell["kind"]](
        cell, out, needs
    )


def _behaviour(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    from ppo_dap.training import tiers

    settings = cell["settings"]
    _clear_unstarted(tiers.behaviour_folder(settings["task"], settings["seed"], settings["steps"], out))
    run = tiers.behave(settings["task"], settings["seed"], settings["steps"], out).run
    if not run.finished:
        raise Stopped


def _logs(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    from ppo_dap.training import tiers

    behaviours = out / tiers.STORE
    behaviours.mkdir(parents=True, exist_ok=True)
    for need in needs.values():
        (folder,) = (path for path in need.iterdir() if path.is_dir())
        link = behaviours / folder.name
        if not link.is_symlink():
            link.symlink_to(os.path.relpath(folder, behaviours))
    s = cell["settings"]
    row = tiers.make_tier(s["task"], s["tier"], s["rows"], s["seed"], s["steps"], out)
    # Who needs these logs knows this folder, and not where Minari's rules for names put a dataset in it.
    write_atomically(out / "logs.json", json.dumps({"folder": os.path.relpath(row["out"], out)}).encode())


def _dataset(out: Path) -> Path:
    """The logs that `_logs` made in `out`."""
    return out / json.loads((out / "logs.json").read_text())["folder"]


def _prior(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    from ppo_dap.logs import best_episodes, load_logs
    from ppo_dap.logs.coverage import cover
    from ppo_dap.priors import fit_prior
    from ppo_dap.tasks import describe

    settings = cell["settings"]
    found = load_logs(_dataset(needs["logs"]), seed=settings["seed"])
    found = best_episodes(found, settings["logs_filter"])
    found = cover(found, settings["coverage"], settings["seed"], settings["coverage_fraction"])
    assert found.task is not None  # tiers say it
    spec = describe(found.task)
    bounds = {"action_low": spec.action_low, "action_high": spec.action_high}
    fit_prior(found, settings["kind"], seed=settings["seed"], **bounds, **cell["call"]).save(out / "prior")


def _run(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    from ppo_dap.training.run import train

    _clear_unstarted(out)
    settings = cell["settings"]
    prior = needs["prior"] / "prior" if "prior" in needs else settings.get("prior")
    run = train(
        settings["task"],
        settings["method"],
        prior=prior,
        logs=_dataset(needs["logs"]) if "logs" in needs else None,
        out=out,
        preset=settings["preset"],
        resume=(out / "config.json").is_file(),
        progress=False,
        **cell["call"],
    )
    if not run.finished:
        raise Stopped
    for name, value in run.config["config"].items():
        if name in settings and settings[name] != value:
            raise PPODAPError(f"the run has {name} {value!r} where the study planned {settings[name]!r}")


def _clear_unstarted(folder: Path) -> None:
    """Remove what a kill left in a run folder before there was a run."""
    if folder.is_dir() and not (folder / "config.json").is_file():
        shutil.rmtree(folder)


def _reliability(cell: Mapping[str, Any], out: Path, needs: Mapping[str, Path]) -> None:
    import numpy as np

    from ppo_dap.study.diagnostics.reliability_report import reliability

    found = reliability(needs["run"], needs["prior"] / "prior", **cell["settings"])
    out.mkdir(parents=True, exist_ok=True)
    np.savez(out / "pairs.npz", q=found.pairs.q, returns=found.pairs.returns, values=found.pairs.values)
    write_atomically(out / "report.json", json.dumps(found.report).encode())


def main(arguments: Sequence[str] | None = None, make: Make = make_cell, beat: float = BEAT) -> int:
    """The command of a worker's process."""
    parser = argparse.ArgumentParser(prog="ppo_dap.study.store.worker", description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("cell")
    parser.add_argument("claim", type=int)
    options = parser.parse_args(arguments)
    # It is how we are asked to stop, and what a script starts in its background begins with it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return work(Store(options.store), options.cell, options.claim, make, beat)
    except OSError as error:
        print(told(error), file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    sys.exit(main())
