"""The settings: what the paper and the recipe say is what stands in the code, and nothing impossible gets in."""

import copy
import dataclasses
import math
import typing

import pytest

from ppo_dap import config as configs
from ppo_dap.config import PRESETS, Config, field_groups, flatten, make, replace, validate
from ppo_dap.errors import InputError

# Typed by hand from the paper's Table 2 (and 5.1), with the names that we gave its rows.
TABLE_2 = {
    "steps": 1_000_000,
    "clip_epsilon": 0.2,
    "gae_lambda": 0.95,
    "minibatch_size": 256,
    "kl_target": 0.02,
    "num_proposals": 10,
    "sampler_steps": 20,
    "beta_max": 1.0,
    "beta_anneal": 0.3,
    "alpha_max": 0.30,
    "guidance_cap": 0.1,
    "lambda_kl": 5e-3,
    "lambda_aux": 1e-2,
    "pet_frequency": 10,
    "adapter_rank": 8,
    "pet_learning_rate": 1e-5,
    "proposal_fraction": 0.2,
}
# The one recipe for every method, typed by hand from the decision on what the paper leaves open.
RECIPE = {
    "hidden_size": 64,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "learning_rate": 3e-4,
    "rollout_steps": 2048,
    "minibatch_size": 256,
    "num_epochs": 10,
    "max_grad_norm": 0.5,
    "observation_clip": 10.0,
}

HINTS = {
    name: typing.get_type_hints(cls)[name]
    for cls in typing.get_type_hints(Config).values()
    for name in (f.name for f in dataclasses.fields(cls))
}
CHOICES = [name for name, hint in HINTS.items() if typing.get_origin(hint) is typing.Literal]
NUMBERS = [name for name, hint in HINTS.items() if {int, float} & {hint, *typing.get_args(hint)}]


def kinds(name: str) -> tuple:
    return typing.get_args(HINTS[name]) or (HINTS[name],)


def planted(**options) -> Config:
    """The defaults with `options` set behind the back of the type checker that the tests run under."""
    config = copy.deepcopy(Config())
    for name, value in options.items():
        object.__setattr__(getattr(config, field_groups()[name]), name, value)
    return config


def refused(**options) -> str:
    with pytest.raises(InputError) as caught:
        validate(planted(**options))
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(("name", "value"), [*TABLE_2.items(), *RECIPE.items()])
def test_defaults_are_the_papers(name, value):
    assert flatten(make("paper"))[name] == flatten(Config())[name] == value


def test_guidance_is_both_by_default_and_no_warm_start():
    assert flatten(Config())["guidance"] == "energy+gradient"
    assert flatten(Config())["warm_start"] == "none"


def test_presets_differ_from_the_paper_only_where_they_say():
    assert set(PRESETS) == {"paper", "tuned", "tuned-warm"}
    assert make("paper") == make() == Config()
    default = flatten(Config())
    for name, stated in PRESETS.items():
        changed = {n: v for n, v in flatten(make(name)).items() if v != default[n]}
        assert changed == stated
    assert PRESETS["tuned"]


def test_options_go_on_top_of_the_preset():
    assert make("tuned", lambda_kl=0.5).objective.lambda_kl == 0.5


def test_unknown_preset_lists_them():
    with pytest.raises(InputError, match=r"unknown preset 'best': .*paper, tuned, tuned-warm"):
        make("best")


def test_flatten_is_the_inverse_of_replace():
    changed = make("tuned", steps=5, top_k=3, displacement_cap=0.5, tensorboard=False, adapter="bottleneck", seed=7)
    assert replace(Config(), **flatten(changed)) == changed != Config()
    assert flatten(replace(Config(), **flatten(changed))) == flatten(changed)


def test_field_names_are_unique_over_groups():
    names = [f.name for cls in typing.get_type_hints(Config).values() for f in dataclasses.fields(cls)]
    assert len(names) == len(set(names)) == len(field_groups()) == len(flatten(Config()))
    assert set(NUMBERS) | set(CHOICES) | {
        "tensorboard",
        "pin_core",
        "keep_history",
        "q_warm_start",
        "guidance_gate",
    } == set(names)


def test_every_number_has_a_rule():
    assert set(configs._RULES) == set(NUMBERS)


@pytest.mark.parametrize("name", HINTS)
def test_wrong_types_are_refused_by_name(name):
    wrong = ["a word", [1], math.nan]
    if bool not in kinds(name):
        wrong += [True, False]
    if int in kinds(name):
        wrong += [1.5, 2.0, math.inf, "10"]
    if bool in kinds(name):
        wrong += [1, 0, "true"]
    if type(None) not in kinds(name):
        wrong.append(None)
    for value in wrong:
        text = refused(**{name: value})
        assert name in text
        assert "must be" in text or "known are" in text
        assert repr(value) in text


@pytest.mark.parametrize("name", NUMBERS)
def test_negative_numbers_are_refused_by_name(name):
    negative = -2 if name == "clip_slope" else -1
    text = refused(**{name: negative})
    assert text.startswith(f"{name} must be a number")
    assert text.endswith(f"not {negative}")


def test_a_clips_slope_is_from_minus_1_to_1():
    for slope in (-1, -0.3, 0, 1):
        validate(planted(clip_slope=slope))
    for slope in (-1.01, 1.01):
        assert refused(clip_slope=slope) == f"clip_slope must be a number from -1 to 1, not {slope}"


def test_at_most_one_batch_is_reused():
    assert replace(Config(), reuse_batches=1).ppo.reuse_batches == 1
    assert refused(reuse_batches=2) == "reuse_batches must be a number from 0 to 1, not 2"


AT_LEAST_0 = {"value_coefficient", "beta_max", "alpha_max", "lambda_kl", "lambda_aux", "pet_frequency", "eval_every"}
AT_LEAST_0 |= {
    "q_pessimism",
    "mode_seeking",
    "prior_return_weight",
    "lambda_awr",
    "contest_kl_weight",
    "std_floor",
    "std_after",
}


@pytest.mark.parametrize("name", NUMBERS)
def test_zero_is_refused_where_it_cannot_work(name):
    if name in AT_LEAST_0 | {"seed", "gamma", "gae_lambda", "clip_slope", "reuse_batches"}:
        validate(planted(**{name: 0}))
    else:
        assert name in refused(**{name: 0})


@pytest.mark.parametrize("name", ["gamma", "gae_lambda", "proposal_fraction", "beta_anneal", "lambda_decay"])
def test_shares_above_1_are_refused(name):
    assert name in refused(**{name: 1.01})
    validate(planted(**{name: 1}))


@pytest.mark.parametrize(
    "name",
    [
        *("learning_rate", "q_learning_rate", "pet_learning_rate", "lambda_kl", "lambda_aux", "value_coefficient"),
        *("beta_max", "alpha_max"),
    ],
)
def test_infinite_rates_and_weights_are_refused(name):
    assert name in refused(**{name: math.inf})


def test_a_seed_that_no_generator_takes_is_refused():
    assert "seed" in refused(seed=2**64)


@pytest.mark.parametrize("name", CHOICES)
def test_choices_are_listed(name):
    text = refused(**{name: "foo"})
    assert f"unknown value of {name} 'foo'" in text
    assert all(choice in text for choice in typing.get_args(HINTS[name]))


def test_whole_numbers_are_fine_for_floats():
    validate(planted(lambda_kl=0, gamma=1))


def test_replace_raises_what_validate_says():
    with pytest.raises(InputError, match=r"gamma must be a number from 0 to 1, not 2.0"):
        replace(Config(), gamma=2.0)


def test_rollout_must_split_into_environments_and_minibatches():
    assert refused(num_envs=3) == "rollout_steps 2048 must be a multiple of num_envs 3"
    assert refused(minibatch_size=100) == "rollout_steps 2048 must be a multiple of minibatch_size 100"
    assert refused(rollout_steps=1000) == "rollout_steps 1000 must be a multiple of minibatch_size 256"
    assert replace(Config(), rollout_steps=1000, minibatch_size=100).ppo.rollout_steps == 1000


def test_top_k_is_at_most_the_number_of_proposals():
    assert refused(top_k=11) == "top_k 11 must be at most num_proposals 10"
    assert replace(Config(), top_k=10).proposals.top_k == 10
    assert replace(Config(), top_k=11, num_proposals=11).proposals.top_k == 11


def test_an_unknown_option_is_answered_with_the_nearest():
    with pytest.raises(InputError, match=r"^unknown option 'lambda_kll': did you mean 'lambda_kl'\?$"):
        replace(Config(), lambda_kll=1)
