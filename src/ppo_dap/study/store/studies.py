"""The studies: every table, figure and experiment of Section 5 as a grid of cells. What several need is the same cell.

A study says which runs there are, with labels to find them by; what is drawn or computed from them is said elsewhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ppo_dap.errors import InputError, unknown
from ppo_dap.methods import METHODS, get_method
from ppo_dap.study.store import cells
from ppo_dap.study.store.grids import Arm, Entry, Scale, Setting, Study
from ppo_dap.tasks import CATALOGUE

WALKER = Setting("Walker2d-v5", "medium-expert")
CHEETAH = Setting("HalfCheetah-v5", "medium-replay")
HOPPER = Setting("Hopper-v5", "medium-expert")
STANDUP = Setting("HumanoidStandup-v5", "medium-expert")
D4RL = (WALKER, CHEETAH, HOPPER)
"""Settings of Table 5 and 5.5 that the paper names by D4RL's names."""
FOUR = (*D4RL, STANDUP)
"""Table 5. For HumanoidStandup the paper says self-collected and no more."""
EIGHT = tuple(next((s for s in FOUR if s.task == task), Setting(task, "medium-expert")) for task in CATALOGUE)
"""Table 4. Where the paper names no tier, it is medium-expert."""
MIXED = tuple(Setting(s.task, "mixed") for s in (WALKER, HOPPER))
"""Logs of several gaits."""

PPO, BC = Arm("PPO", "ppo"), Arm("PPO + BC", "ppo-bc")
DAP, TUNED = Arm("PPO-DAP"), Arm("PPO-DAP (tuned)", preset="tuned")
TUNED_WARM = Arm("PPO-DAP (tuned-warm)", preset="tuned-warm")
NO_PET = Arm("No-PET", "ppo-dap-no-pet", axes={"f": 0})
NO_VG = Arm("No-VG", "ppo-dap-no-vg")
VARIANTS = (Arm("PPO-GC", "ppo-gc"), Arm("PPO-ARC", "ppo-arc"), Arm("ABPPO", "ppo-abppo"))
THIN: dict[str, Any] = {"coverage_fraction": 0.2}
"""Share of the rows at the levels below wide. Of medium-expert logs, whose best episodes are long, those of middling
return hold little more than a quarter."""
MITIGATIONS = {
    "gate and beta 0.6": {"guidance_gate": True, "beta_max": 0.6},
    "K 20 with the 10 most diverse": {"num_proposals": 20, "keep_diverse": 10},
    "alpha 0.2": {"alpha_max": 0.2},
    "Q calibrated": {"q_calibration": "affine"},
}
"""What 5.6 recommends for narrow logs."""
PARTS: tuple[tuple[str, dict[str, Any], dict[str, Any]], ...] = (
    ("no guidance", {"guidance": "none"}, {}),
    ("no PET", {"pet_frequency": 0}, {}),
    ("V not started", {"warm_start": "actor"}, {}),
    ("nothing started", {"warm_start": "none"}, {}),
    ("all logs", {"logs_filter": 1.0}, {"logs_filter": 1.0}),
    ("KL never decayed", {"lambda_decay": None}, {}),
    ("imitation beside the KL", {"lambda_aux": 0.3}, {}),
    ("mode-seeking imitation", {"lambda_aux": 0.3, "mode_seeking": 1.0}, {}),
    ("Q started in place of V", {"warm_start": "actor", "q_warm_start": True}, {}),
    ("asked for the top return", {"prior_return": "top"}, {"condition_on": "return", "logs_filter": 1.0}),
)
"""What PPO-DAP (tuned-warm) is without a part, or with one more: (name, its options, those of its prior)."""

Entries = Iterable[Entry]


def table4(s: Scale) -> Entries:
    """Final return, eight tasks."""
    return s.full(EIGHT, [PPO, DAP, TUNED, TUNED_WARM, *VARIANTS])


def table5(s: Scale) -> Entries:
    """Early efficiency and final return, four settings."""
    arms = [PPO, BC, DAP, TUNED, TUNED_WARM]
    yield from s.early(FOUR, arms, s.many)
    yield from s.full(FOUR, arms)


def _frequencies(s: Scale) -> list[Arm]:
    """f = 0, 5, 10, 20; 10 is Table 2's, so that arm is PPO-DAP itself."""
    tuned = (Arm(f"PET f={f}", options={} if f == 10 else {"pet_frequency": f}, axes={"f": f}) for f in (5, 20, 10))
    return s.of_presets(*s.ends([NO_PET, *tuned]))


def table6(s: Scale) -> Entries:
    """PET: what it costs and what it gains, Walker2d."""
    return s.full([WALKER], [PPO, *_frequencies(s)])


def table7(s: Scale) -> Entries:
    """Compute fairness, eight tasks; Diffusion-NoVG is No-VG under another name."""
    yield from s.early(EIGHT, [PPO, BC])
    yield from s.early(EIGHT, s.of_presets(DAP, NO_VG, NO_PET, Arm("VAE + PPO", "ppo-vae")))


def fig6(s: Scale) -> Entries:
    """Learning curves and episode length, Walker2d."""
    return s.full([WALKER], [PPO, DAP, TUNED, TUNED_WARM])


def fig7(s: Scale) -> Entries:
    """Forest plot: early gains on Table 5's settings, final gains on all tasks."""
    arms = [PPO, DAP, TUNED, TUNED_WARM]
    yield from s.early(FOUR, arms, s.many)
    yield from s.full(EIGHT, arms)


def fig9(s: Scale) -> Entries:
    """Proposal budget: K, and the share of an iteration's states that get proposals."""
    budgets = [Arm(f"K={k}", options={} if k == 10 else {"num_proposals": k}, axes={"K": k}) for k in (10, 5, 15, 20)]
    shares = [
        Arm(f"share={x:g}", options={} if x == 0.2 else {"proposal_fraction": x}, axes={"share": x})
        for x in (0.2, 0.05, 0.5, 1.0)
    ]
    yield from s.early(D4RL, [PPO, *s.of_presets(*s.ends(budgets), *s.ends(shares))])


def fig10(s: Scale) -> Entries:
    """PET frequency: curves and distribution, HalfCheetah medium-replay."""
    return s.early([CHEETAH], [PPO, *_frequencies(s)], s.many)


def fig11(s: Scale) -> Entries:
    """Proposals of one run's checkpoint with and without guidance (t-SNE); no run but PPO-DAP's is needed."""
    return s.early([WALKER], s.of_presets(DAP))


def _coverages(s: Scale) -> list[Arm]:
    levels = ("wide", "medium", "narrow")
    return s.of_presets(*(Arm(f"{x} logs", fit=_fit(x), axes={"coverage": x}) for x in s.ends(levels)))


def _fit(coverage: str) -> dict[str, Any]:
    """Levels thin all of the logs, in every preset: of the best episodes alone there are too few to thin."""
    return {"logs_filter": 1.0} | ({} if coverage == "wide" else {"coverage": coverage, **THIN})


def fig12(s: Scale) -> Entries:
    """Coverage sensitivity: gains, high-Q rate and ESS at three levels."""
    return s.early(FOUR, [PPO, *_coverages(s)])


def coverage(s: Scale) -> Entries:
    """5.6: Fig. 12's runs, and what the paper recommends for narrow logs, each alone and all together."""
    every = {"all four": {k: v for options in MITIGATIONS.values() for k, v in options.items()}}
    axes = {"coverage": "narrow"}
    arms = [
        Arm(f"narrow logs: {name}", options=options, fit=_fit("narrow"), axes=axes | {"mitigation": name})
        for name, options in (every if s.brief else MITIGATIONS | every).items()
    ]
    yield from fig12(s)
    yield from s.early(FOUR, s.of_presets(*arms))


def ablation(s: Scale) -> Entries:
    """5.5: kind of prior x guidance x PET frequency, and the controls of Table 3 that leave a part out."""
    arms = []
    for guidance in s.ends(("none", "energy", "energy+gradient")):
        for f in s.ends((0, 20, 10)):
            options = {} if guidance == "energy+gradient" else {"guidance": guidance}
            options |= {} if f in (0, 10) else {"pet_frequency": f}
            method = "ppo-dap-no-pet" if f == 0 else "ppo-dap"
            axes = {"prior": "diffusion", "guidance": guidance, "f": f}
            arms.append(Arm(f"diffusion / {guidance} / f={f}", method, options=options, axes=axes))
    for guidance in ("energy",) if s.brief else ("none", "energy"):
        axes = {"prior": "flow", "guidance": guidance, "f": 0}
        arms.append(Arm(f"flow / {guidance}", "ppo-flow", options={"guidance": guidance}, axes=axes))
    controls = ("ppo-dap-prior-kl-only", "ppo-dap-aux-only", "ppo-behavior-kl", "ppo-vae", "ppo-retrieval")
    arms += [Arm(get_method(name).row, name) for name in (controls[:1] if s.brief else controls)]
    yield from s.early(D4RL, [PPO._replace(axes={"prior": "none"}), Arm("PPO + AWR", "ppo-awr")])
    yield from s.early(D4RL, s.of_presets(*arms))


def reliability(s: Scale) -> Entries:
    """5.7: how far Q can be trusted, with Q's target and with advantages (the advantage-energy baseline)."""
    arms = s.of_presets(DAP, Arm("advantage energy", options={"q_target": "advantage"}))
    for entry in s.early(FOUR, arms):
        yield entry
        yield Entry(cells.reliability(entry.cell, **s.reliability), entry.labels | {"part": "report"})


def audit(s: Scale) -> Entries:
    """5.8: the audit's measures in every iteration, all tasks; PPO-ARC is the one that has to be caught."""
    return s.full(EIGHT, [PPO, DAP, TUNED, TUNED_WARM, Arm("PPO-ARC", "ppo-arc")])


def mixed(s: Scale) -> Entries:
    """Logs of several gaits: every method, the clones of the best logs, and PPO-DAP (tuned-warm) without each part."""
    best = {"logs_filter": 0.3}
    clones = [
        Arm("PPO + BC (best 30%)", "ppo-bc", options=best),
        Arm("PPO + BC (best 30%; V started)", "ppo-bc", options={**best, "warm_start": "actor_critic"}),
    ]
    yield from s.early(MIXED, [TUNED_WARM, BC, *([] if s.brief else clones), PPO], s.many)
    parts = [
        TUNED_WARM._replace(name=f"{TUNED_WARM.name}: {name}", options=options, fit=fit) for name, options, fit in PARTS
    ]
    yield from s.early(MIXED, s.ends(parts))
    if not s.brief:
        yield from s.full(MIXED, [TUNED_WARM, BC, *clones])
        others = [Arm(m.row, m.name) for m in METHODS.values() if m.name not in ("ppo", "ppo-bc")]
        yield from s.early(MIXED, others, s.many)


STUDIES: dict[str, Callable[[Scale], Entries]] = {
    "table4": table4,
    "table5": table5,
    "table6": table6,
    "table7": table7,
    "fig6": fig6,
    "fig7": fig7,
    "fig8": table7,
    "fig9": fig9,
    "fig10": fig10,
    "fig11": fig11,
    "fig12": fig12,
    "ablation": ablation,
    "coverage": coverage,
    "reliability": reliability,
    "audit": audit,
    "mixed": mixed,
}
"""Name -> its entries at a scale. `all` is all of these, `smoke` all of these at the scale `SMOKE`."""

SMOKE = Scale(
    early_steps=384,
    full_steps=384,
    many=(0,),
    few=(0,),
    rows=2_000,
    behaviour_steps=20_000,
    run_options={
        "tensorboard": False, "num_envs": 4, "rollout_steps": 128, "minibatch_size": 32, "num_epochs": 2,
        "eval_every": 128, "eval_episodes": 2, "checkpoint_every": 2,
    },
    guided_options={"num_proposals": 4, "sampler_steps": 2},
    fit_options={"max_steps": 40, "chunk_steps": 20, "batch_size": 64},
    reliability={"states": 4, "rollouts": 2, "horizon": 20},
    task="Hopper-v5",
    presets=("tuned",),
    brief=True,
)  # fmt: skip
"""Everything there is, on one task, in minutes; its numbers mean nothing."""


def make_study(
    name: str, *, scale: Scale | None = None, seeds: Sequence[int] | None = None, steps: int | None = None
) -> Study:
    """The study of that name; `seeds` and `steps` take the place of all those that it declares.

    Raises `InputError` for a name that is none.
    """
    if name not in (*STUDIES, "all", "smoke"):
        raise unknown("study", name, [*STUDIES, "all", "smoke"])
    scale = scale or (SMOKE if name == "smoke" else Scale())
    if seeds is not None:
        scale = dataclasses.replace(scale, many=tuple(seeds), few=tuple(seeds))
    if steps is not None:
        scale = dataclasses.replace(scale, early_steps=steps, full_steps=steps)
    names = list(STUDIES) if name in ("all", "smoke") else [name]
    entries = [e._replace(labels={"study": part} | e.labels) for part in names for e in STUDIES[part](scale)]
    title = {"all": "every table and figure", "smoke": "every table and figure, tiny"}.get(name) or _title(name)
    return Study(name, title, scale.epochs, tuple(entries))


def _title(name: str) -> str:
    return (STUDIES[name].__doc__ or "").splitlines()[0].rstrip(".")


def parts(study: Study) -> list[Study]:
    """The studies that one is made of: those that `all` and `smoke` join, or itself."""
    names = dict.fromkeys(entry.labels["study"] for entry in study.entries)
    return [
        Study(name, _title(name), study.epochs, tuple(e for e in study.entries if e.labels["study"] == name))
        for name in names
    ]


def only(study: Study, wanted: Mapping[str, Sequence[str]]) -> Study:
    """The entries whose labels have one of the `wanted` values; raises `InputError` for a label or value of none."""
    entries = study.entries
    for name, values in wanted.items():
        known = {str(e.labels[name]) for e in study.entries if name in e.labels}
        if not known:
            raise unknown("label", name, {label for e in study.entries for label in e.labels})
        for value in values:
            if value not in known:
                raise unknown(f"{name} in study {study.name}", value, known)
        entries = tuple(e for e in entries if str(e.labels.get(name)) in values)
    if not entries:
        raise InputError(f"no run of study {study.name} has all of {dict(wanted)}: leave one of them out")
    return dataclasses.replace(study, entries=entries)
