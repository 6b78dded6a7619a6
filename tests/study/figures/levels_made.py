"""Results of a study that was never run: every figure a round function of what the run is, plus noise of its seed."""

import zlib

import numpy as np

from ppo_dap.study.results import Results

LEVELS = {
    "Ant": (900, 200), "HalfCheetah": (350, 900), "Hopper": (600, 500), "HumanoidStandup": (60_000, 30_000),
    "Pusher": (-80, 30), "Striker": (-300, 60), "Swimmer": (30, 20), "Walker2d": (450, 800),
}  # fmt: skip
"""Task -> what PPO earns early, and what it learns later."""
GAIN = {"paper": 0.6, "tuned": 1.4, "tuned-warm": 2.2}


def made_results(study, noise=0.15, done=lambda labels: True):
    """Results with a row for every entry of the study whose labels are `done`."""
    found = Results()
    for entry in study.entries:
        labels, cell = entry.labels, entry.cell
        rng = np.random.default_rng([labels["seed"], zlib.crc32(labels["arm"].encode())])
        if not done(labels):
            continue
        if cell.kind == "reliability":
            found.reports[cell.name] = _report(cell.needs["run"].name, rng)
            continue
        early, later = LEVELS[labels["task"].partition("-")[0]]
        method = labels["method"]
        gain = {"ppo": 0.0, "ppo-bc": 0.3, "ppo-arc": 0.05}.get(method, GAIN[labels["preset"]])
        gain += 0.01 * labels.get("f", 0) + 0.02 * labels.get("K", 0) + 0.3 * labels.get("share", 0)
        gain -= {"medium": 0.3, "narrow": 0.5}.get(labels.get("coverage", ""), 0)
        steps = np.linspace(0, labels["steps"], 41).astype(int)
        share = steps / labels["steps"]
        height = early + later * share + abs(early) * (gain + noise * rng.standard_normal()) * np.sqrt(share)
        height = height + 0.1 * abs(early) * rng.standard_normal(len(share)) * share
        found.curves[cell.name] = [
            {"env_steps": int(s), "return_mean": float(h), "length_mean": float(200 + 800 * x / (x + 0.3 - 0.1 * gain))}
            for s, h, x in zip(steps, height, share, strict=True)
        ]
        guided = method not in ("ppo", "ppo-bc", "ppo-arc", "ppo-gc", "ppo-abppo", "ppo-awr")
        found.runs[cell.name] = {
            "task": labels["task"], "method": method, "preset": labels["preset"], "seed": labels["seed"],
            "steps": labels["steps"], "last_return": float(height[-1]), "env_steps": labels["steps"],
            "seconds_iteration": labels["steps"] / 3000 * (1 + 0.2 * gain * guided + 0.02 * rng.standard_normal()),
            "ess": 8 - 2 * (1 - gain) + rng.random() if guided else None,
            "high_q_rate": 0.15 + 0.05 * gain + 0.01 * rng.random() if guided else None,
            "policy_kl": 0.01 * (1 + 0.2 * rng.random()), "kl_to_prior": 5 + rng.random() if guided else None,
            "prior_kl": 1e-6 * gain * (1 + rng.random()) if guided else None, "oglr": 0.0 if guided else None,
            "spr": 1.0 if guided else None, "pgshare": 0.6 + 0.1 * rng.random() if guided else 1.0,
            "batch_fresh": 0.6 if method == "ppo-arc" else 1.0,
        }  # fmt: skip
    return found


def _report(run, rng):
    guided = rng.random()
    return {
        "of": run, "q.proposals.rho": 0.2 + 0.1 * rng.random(), "rank_ceiling.proposals": 0.7 + 0.1 * rng.random(),
        "calibration.as it is.ece": 3 + rng.random(), "calibration.affine.ece": 0.5 + 0.2 * rng.random(),
        "returns.unguided": 10.0, "returns.reweighted": 10.0 + guided,
    }  # fmt: skip
