import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.stats import norm

from ppo.ppo_made import BOTH, HIGH, LOW, TERMINATES, TRUNCATES, Scripted, make_policy, scripted_reward
from ppo_dap.ppo.gae import gae
from ppo_dap.ppo.rollout import Collector, Rollout
from ppo_dap.tasks.vector import Transition, wrap_gymnasium

SCRIPTS = [
    [(3, TERMINATES), (1, TRUNCATES), (4, TRUNCATES), (2, BOTH)],
    [(2, TRUNCATES), (5, TERMINATES)],
    [(1, TERMINATES)],
    [(100, TRUNCATES)],
]
MODES = list(AutoresetMode)
GAE = jax.jit(lambda *columns: gae(*columns, 0.9, 0.8))


def collect(mode, rollouts=2, steps=80, first_iteration=0, wrap=lambda env: env, parts=4):
    """Environments, collector, and the parts of all rollouts in a row."""
    scripted = [Scripted(script) for script in SCRIPTS]
    vector = SyncVectorEnv([lambda env=env: env for env in scripted], autoreset_mode=mode)
    collector = Collector(wrap(wrap_gymnasium(vector, seed=0)))
    rng, policy = np.random.default_rng(0), make_policy()
    collected = [collector.collect(policy, steps, parts, first_iteration + i, rng) for i in range(rollouts)]
    return scripted, collector, [part for rollout in collected for part in rollout]


def columns(rollouts, *names):
    """All parts end to end, an array (time, envs, ...) for each name."""
    return [np.concatenate([np.asarray(getattr(r, name)) for r in rollouts]) for name in names]


def episodes(rollouts, env):
    """The whole episodes of one environment: lists of (obs, next_obs, reward, terminated, truncated)."""
    names = ("valid", "observations", "next_observations", "rewards", "terminated", "truncated")
    whole, rows = [], []
    for valid, obs, next_obs, *rest in zip(*(c[:, env].tolist() for c in columns(rollouts, *names)), strict=True):
        if valid:
            rows.append((tuple(obs), tuple(next_obs), *rest))
            if any(rest[1:]):
                whole.append(rows)
                rows = []
    return whole


def scripted_episode(script, number):
    length, flags = script[number % len(script)]
    return [
        ((t, number), (t + 1, number), scripted_reward(t + 1, number), *(flags if t + 1 == length else (False, False)))
        for t in range(length)
    ]


def matches_the_script(rollouts):
    """Whether every environment went through its script, and how many episodes each finished."""
    counts = [len(episodes(rollouts, env)) for env in range(len(SCRIPTS))]
    right = all(
        episodes(rollouts, env) == [scripted_episode(script, i) for i in range(counts[env])]
        for env, script in enumerate(SCRIPTS)
    )
    return right, counts


@pytest.mark.parametrize("mode", MODES)
def test_every_autoreset_mode_gives_the_scripted_episodes(mode):
    _, collector, rollouts = collect(mode)
    right, counts = matches_the_script(rollouts)
    assert right
    assert counts[:3] == ([11, 9, 20] if mode == AutoresetMode.NEXT_STEP else [16, 11, 40])
    sums = Counter(sum(row[2] for row in episode) for env in range(4) for episode in episodes(rollouts, env))
    assert Counter(collector.finished_returns) == sums


@pytest.mark.parametrize("mode", MODES)
def test_only_late_resets_have_masked_rows(mode):
    _, _, rollouts = collect(mode)
    valid, terminated, truncated, rewards = columns(rollouts, "valid", "terminated", "truncated", "rewards")
    ended = terminated | truncated
    if mode == AutoresetMode.NEXT_STEP:
        np.testing.assert_array_equal(~valid[1:], ended[:-1])
        assert not np.any((rewards != 0) | ended, where=~valid)
        assert (~valid).sum() > 30
    else:
        assert valid.all()


class ResetInsteadOfFinal:
    """Planted fault: the successor of an episode's last row is the next episode's first observation."""

    def __init__(self, env):
        self.env, self.num_envs, self.reset, self.close = env, env.num_envs, env.reset, env.close

    def step(self, actions):
        step = self.env.step(actions)
        return step._replace(next_observations=step.observations)


class NothingMasked(ResetInsteadOfFinal):
    """Planted fault: rows in which the environment was being reset count."""

    def step(self, actions) -> Transition:
        step = self.env.step(actions)
        return step._replace(valid=np.ones_like(step.valid))


@pytest.mark.parametrize(
    ("mode", "fault"),
    [
        (AutoresetMode.SAME_STEP, ResetInsteadOfFinal),
        (AutoresetMode.DISABLED, ResetInsteadOfFinal),
        (AutoresetMode.NEXT_STEP, NothingMasked),
    ],
)
def test_planted_autoreset_faults_are_seen(mode, fault):
    assert not matches_the_script(collect(mode, wrap=fault)[2])[0]


def advantages(rollouts, env):
    """GAE of one environment's whole episodes, with V a fixed function of the observation."""

    def value(observations):
        return jnp.asarray(np.sin(observations[..., 0] + 0.3 * observations[..., 1]))

    names = ("observations", "next_observations", "rewards", "terminated", "truncated", "valid")
    obs, next_obs, rewards, terminated, truncated, valid = columns(rollouts, *names)
    flags = (jnp.asarray(f) for f in (terminated, truncated, valid))
    out = np.asarray(GAE(jnp.asarray(rewards), value(obs), value(next_obs), *flags))
    ends = np.flatnonzero((terminated | truncated)[:, env])
    return out[: ends[-1] + 1, env][valid[: ends[-1] + 1, env]] if len(ends) else out[:0, env]


def test_the_modes_give_the_same_advantages():
    next_step, same_step, disabled = (collect(mode)[2] for mode in MODES)
    for env in range(3):
        expected = advantages(same_step, env)
        np.testing.assert_array_equal(advantages(disabled, env), expected)
        fewer = advantages(next_step, env)
        np.testing.assert_allclose(fewer, expected[: len(fewer)], rtol=1e-5, atol=1e-6)


def test_state_ids_are_unique_and_count_rows():
    _, _, rollouts = collect(AutoresetMode.NEXT_STEP, rollouts=3, first_iteration=5)
    ids = np.concatenate([r.state_ids.ravel() for r in rollouts])
    np.testing.assert_array_equal(ids, np.arange(5 * 80, 8 * 80))


def test_actions_are_sampled_from_the_policy_and_clipped_only_for_the_environment():
    scripted, _, rollouts = collect(AutoresetMode.SAME_STEP)
    policy = make_policy()
    actions, means, log_probs, obs = columns(rollouts, "actions", "means", "log_probs", "observations")
    np.testing.assert_allclose(log_probs, norm.logpdf(actions, means, np.exp(policy.log_std)).sum(-1), rtol=1e-4)
    np.testing.assert_allclose(means.reshape(-1, 2), policy.mean(obs.reshape(-1, 2)), rtol=1e-5)
    z = (actions - means) / np.exp(policy.log_std)
    assert abs(z.mean()) < 0.2
    assert 0.85 < z.std() < 1.15
    assert np.abs(actions).max() > 1  # not clipped in D_on
    sent = np.clip((LOW + HIGH) / 2 + actions * (HIGH - LOW) / 2, LOW, HIGH)
    for env, scripted_env in enumerate(scripted):
        np.testing.assert_allclose(np.stack(scripted_env.actions), sent[:, env], atol=1e-6)


def test_the_same_generator_gives_the_same_rollout():
    first, again = (columns(collect(AutoresetMode.SAME_STEP)[2], "actions", "log_probs") for _ in range(2))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


@pytest.mark.parametrize("parts", [2, 5])
def test_parts_end_to_end_are_the_rollout_in_one(parts):
    names = [field.name for field in dataclasses.fields(Rollout)]
    _, whole_collector, whole = collect(AutoresetMode.NEXT_STEP, parts=1)
    _, collector, rollouts = collect(AutoresetMode.NEXT_STEP, parts=parts)
    assert [len(r.rewards) for r in rollouts] == [20 // parts] * (2 * parts)
    for name, joined, one in zip(names, columns(rollouts, *names), columns(whole, *names), strict=True):
        np.testing.assert_array_equal(joined, one, err_msg=name)
    assert collector.finished_returns == whole_collector.finished_returns


def test_a_part_comes_before_the_next_is_stepped_and_stays_as_it_is():
    env = Scripted(SCRIPTS[0])
    vector = SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.SAME_STEP)
    rollout = Collector(wrap_gymnasium(vector, seed=0)).collect(make_policy(), 20, 4, 0, np.random.default_rng(0))
    seen = []
    for number, part in enumerate(rollout, 1):
        assert len(env.actions) == 5 * number
        seen.append((part, jax.tree.map(np.copy, part)))
    for part, copy in seen:
        jax.tree.map(np.testing.assert_array_equal, part, copy)
