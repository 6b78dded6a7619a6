import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppo_dap.ppo.gae import gae

GAMMA, LAMBDA = 0.9, 0.7
FIELDS = ("rewards", "values", "next_values", "terminated", "truncated", "valid")


def random_episodes(seed, time=40, envs=3):
    """Columns of episodes that terminate, are truncated or both; about half the ends are followed by a masked row."""
    rng = np.random.default_rng(seed)
    data = {name: rng.standard_normal((time, envs)).astype(np.float32) for name in ("rewards", "values")}
    data |= {name: np.zeros((time, envs), bool) for name in ("terminated", "truncated")}
    data["valid"] = np.ones((time, envs), bool)
    data["next_values"] = np.concatenate([data["values"][1:], data["values"][:1] + 1])
    for env in range(envs):
        t = rng.integers(1, 7)
        while t < time:
            terminated, truncated = [(True, False), (False, True), (True, True)][rng.integers(3)]
            data["terminated"][t, env], data["truncated"][t, env] = terminated, truncated
            data["next_values"][t, env] = rng.standard_normal()  # V of the final observation, not of row t + 1
            if rng.random() < 0.5 and t + 1 < time:
                t += 1
                data["valid"][t, env] = False
                data["rewards"][t, env] = 100.0
            t += rng.integers(1, 7)
    return data


def brute_force(data):
    """Schulman et al. 2016, Eq. 16: the exponentially weighted mean of n-step returns, less the value."""
    out = np.zeros(data["rewards"].shape)
    time, envs = out.shape
    for env in range(envs):
        rewards, values, next_values, terminated, truncated, valid = (data[name][:, env] for name in FIELDS)
        for t in range(time):
            if not valid[t]:
                continue
            last = t
            while last + 1 < time and not (terminated[last] or truncated[last]):
                last += 1
            steps = last - t + 1
            returns = []
            for n in range(1, steps + 1):
                bootstrap = 0.0 if terminated[t + n - 1] else float(next_values[t + n - 1])
                returns.append(sum(GAMMA**k * float(rewards[t + k]) for k in range(n)) + GAMMA**n * bootstrap)
            weights = [(1 - LAMBDA) * LAMBDA ** (n - 1) for n in range(1, steps)] + [LAMBDA ** (steps - 1)]
            out[t, env] = sum(w * r for w, r in zip(weights, returns, strict=True)) - float(values[t])
    return out


@jax.jit
def run(data):
    return gae(*(data[name] for name in FIELDS), GAMMA, LAMBDA)


def computed(data):
    return np.asarray(run({name: jnp.asarray(value) for name, value in data.items()}))


@pytest.mark.parametrize("seed", range(5))
def test_gae_is_the_weighted_mean_of_n_step_returns(seed):
    data = random_episodes(seed)
    assert data["terminated"].any()
    assert data["truncated"].any()
    assert not data["valid"].all()
    np.testing.assert_allclose(computed(data), brute_force(data), rtol=1e-4, atol=1e-4)


def zero_at_truncation(data):
    return {**data, "terminated": data["terminated"] | data["truncated"]}


def leak_through_truncation(data):
    return {**data, "truncated": np.zeros_like(data["truncated"])}


def own_value_at_truncation(data):
    return {**data, "next_values": np.where(data["truncated"], data["values"], data["next_values"])}


@pytest.mark.parametrize("wrong", [zero_at_truncation, leak_through_truncation, own_value_at_truncation])
def test_the_wrong_variants_differ_where_episodes_are_truncated(wrong):
    data = random_episodes(0)
    data["truncated"] &= ~data["terminated"]
    data["valid"][:] = True  # else a masked row would stop the leak
    truth = brute_force(data)
    np.testing.assert_allclose(computed(data), truth, rtol=1e-4, atol=1e-4)
    differs = np.abs(computed(wrong(data)) - truth) > 1e-2
    assert differs[data["truncated"]].mean() > 0.9


def constant_reward(terminated, truncated):
    ones, shape = np.ones((12, 2), np.float32), (12, 2)
    value = ones / (1 - GAMMA)
    ends = np.arange(1, 13)[:, None] % 4 == 0
    flags = {
        "terminated": np.broadcast_to(ends & terminated, shape),
        "truncated": np.broadcast_to(ends & truncated, shape),
    }
    return {"rewards": ones, "values": value, "next_values": value, "valid": np.ones(shape, bool), **flags}


def test_exact_values_give_no_advantage_at_truncations():
    np.testing.assert_allclose(computed(constant_reward(False, True)), 0, atol=1e-5)


def test_a_termination_costs_the_value_that_does_not_follow():
    steps_to_end = 3 - np.arange(12) % 4
    expected = -GAMMA / (1 - GAMMA) * (GAMMA * LAMBDA) ** steps_to_end
    advantages = computed(constant_reward(True, False))
    np.testing.assert_allclose(advantages, np.stack([expected] * 2, 1), rtol=1e-4)
    np.testing.assert_array_equal(computed(constant_reward(True, True)), advantages)


def test_exact_values_of_terminating_episodes_give_no_advantage():
    data = constant_reward(True, False)
    left = 4 - np.arange(12) % 4
    value = np.stack([(1 - GAMMA**left) / (1 - GAMMA)] * 2, 1).astype(np.float32)
    data |= {"values": value, "next_values": np.roll(value, -1, 0)}
    np.testing.assert_allclose(computed(data), 0, atol=1e-5)


def test_columns_in_another_shape_are_refused():
    data = constant_reward(True, False)
    with pytest.raises(Exception, match="Type-check error"):  # (time, envs) with (time,): pitfall 18
        computed({**data, "rewards": data["rewards"][:, 0]})
