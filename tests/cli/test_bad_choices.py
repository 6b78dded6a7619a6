"""A prior's kind and a method's parts: what is no choice is one line that says what would be right."""

import pytest

from cli.cli_made import TASK
from cli.test_bad_input import is_refused

PRETRAIN = f"pretrain --logs @good.npz --task {TASK} --out out --kind"
TRAIN = f"train --task {TASK} --out out --method"
PRIOR = "--prior @prior"

BAD = {
    "kind": (f"{PRETRAIN} nonsense", "unknown kind 'nonsense'", "behaviour, diffusion, flow, retrieval, vae"),
    "near kind": (f"{PRETRAIN} difusion", "unknown kind 'difusion'", "did you mean 'diffusion'"),
    "the control is not fitted": (f"{PRETRAIN} random", "unknown kind 'random'", "diffusion"),
    "option of another kind": (
        f"{PRETRAIN} flow --sigma-max 3", "sigma_max is no setting of a flow prior", "leave it out",
    ),
    "fit of what is not fitted": (
        f"{PRETRAIN} retrieval --max-steps 3", "max_steps is no setting of a retrieval prior", "leave it out",
    ),
    "setting of a kind": (f"{PRETRAIN} flow --couplings 0", "couplings must be", "above 0", "not 0"),
    "log std floor": (f"{PRETRAIN} behaviour --log-std-floor 1", "log_std_floor must be a number below 0", "not 1"),
    "weight without a prior": (
        f"{TRAIN} ppo --lambda-kl 0.1", "lambda_kl 0.1 has no effect in method ppo", "has no prior", "choose a method",
    ),
    "guidance without a prior": (f"{TRAIN} ppo --guidance energy", "guidance 'energy' has no effect in method ppo"),
    "what the method is": (
        f"{TRAIN} ppo-dap-no-pet --pet-frequency 10 {PRIOR}", "pet_frequency 10 contradicts",
        "which has pet_frequency 0",
    ),
    "what the prior cannot": (
        f"{TRAIN} ppo-flow --guidance gradient --prior random", "guidance 'gradient' contradicts", "'energy' or 'none'",
        "only a diffusion prior has denoising steps",
    ),
    "kind of the prior": (
        f"{TRAIN} ppo-flow {PRIOR}", "ppo-flow needs a flow prior", "of kind 'diffusion'", "--kind flow",
    ),
    "no prior of the kind": (f"{TRAIN} ppo-vae", "ppo-vae needs a vae prior", "--kind vae"),
    "asked of a prior without returns": (
        f"{TRAIN} ppo-dap --prior-return top {PRIOR}", "prior_return 'top'", "condition_on 'return'",
    ),
    "pessimism of one head": (
        f"{TRAIN} ppo-dap --q-pessimism 1 {PRIOR}", "q_pessimism 1.0 needs q_heads of 2 or more, not 1",
    ),
    "more kept than there are": (
        f"{TRAIN} ppo-dap --keep-diverse 11 {PRIOR}", "keep_diverse 11 must be at most num_proposals 10",
    ),
    "temperature without its term": (
        f"{TRAIN} ppo --awr-temperature 2", "awr_temperature 2.0 has no effect in method ppo",
        "needs lambda_awr above 0",
    ),
    "Q's start without a start": (
        f"{TRAIN} ppo-dap --q-warm-start true {PRIOR}", "q_warm_start needs a warm_start", "'actor'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_choice(capsys, files, here, nothing_is_learned, case):
    is_refused(capsys, files, here, *BAD[case])
