"""Q's fit on a problem whose Q is known, and that it leaves V alone unless it is told otherwise."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import spearmanr

from dap.dap_made import bits, changed, filled
from ppo_dap.config import QConfig
from ppo_dap.dap.q_learning import ADAM, QData, fit_q, rank_correlation, trainable
from ppo_dap.nets.critic import Critic, QFunction, q_features
from ppo_dap.ppo.update import draw_orders

ROWS = 256


@pytest.fixture(scope="module")
def critic():
    return filled(lambda rng: Critic.create(rng, 2, 8), 0)


def target(states, actions):
    """A bandit: the best action of state s is 0.5 s_0."""
    return 1 - (actions[..., 0] - 0.5 * states[..., 0]) ** 2


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(1)
    states, actions = rng.uniform(-1, 1, (ROWS, 2)), rng.uniform(-1, 1, (ROWS, 1))
    parts = states, actions, target(states, actions), np.ones(ROWS)
    return QData(*(jnp.asarray(p, jnp.float32) for p in parts))


@pytest.fixture(scope="module")
def fit(critic):
    """(rows, trunk) -> fitted Q, critic, optimizer and loss; each trunk is compiled once."""
    compiled = {}

    def run(rows, trunk):
        config = QConfig(q_trunk=trunk, q_epochs=150, q_learning_rate=1e-2, q_hidden_size=16)
        q = filled(lambda rng: QFunction.create(rng, 2, 1, 8, 16, trunk == "separate"), 2)
        compiled.setdefault(trunk, jax.jit(partial(fit_q, minibatch_size=64, config=config)))
        orders = draw_orders(np.random.default_rng(3), config.q_epochs, ROWS)
        return compiled[trunk](q, critic, ADAM.init(trainable(q, critic, config)), rows, orders)

    return run


@pytest.mark.parametrize("trunk", ["stop_gradient", "shared", "separate"])
def test_q_finds_the_targets_and_the_best_actions(fit, rows, trunk):
    q, critic, _, _ = fit(rows, trunk)
    states = jnp.asarray(np.random.default_rng(9).uniform(-1, 1, (100, 2)), jnp.float32)  # not those it was fitted to
    grid = np.linspace(-1, 1, 41, dtype=np.float32)
    actions = jnp.asarray(np.broadcast_to(grid[:, None], (100, 41, 1)))
    values = np.asarray(q(q_features(critic, q, states, shared=False), actions))
    truth = target(np.asarray(states)[:, None], np.asarray(actions))
    assert np.mean((values - truth) ** 2) < 0.05 * truth.var()
    assert np.abs(grid[values.argmax(1)] - 0.5 * np.asarray(states)[:, 0]).mean() < 0.15


def test_v_is_left_alone_unless_the_trunk_is_shared(fit, rows, critic):
    for trunk in ("stop_gradient", "separate"):
        assert bits(fit(rows, trunk)[1]) == bits(critic)
    moved = fit(rows, "shared")[1]
    assert bits(moved.v_head) == bits(critic.v_head)
    assert all(a != b for a, b in zip(bits(moved.trunk), bits(critic.trunk), strict=True))


def test_rows_without_weight_teach_nothing(fit, rows):
    masked = np.arange(ROWS) % 4 == 0
    weights = jnp.asarray(~masked, jnp.float32)
    poisoned = changed(rows, targets=jnp.where(jnp.asarray(masked), 100.0, rows.targets))
    clean, ignored, counted = (
        fit(data, "stop_gradient")[0]
        for data in (changed(rows, weights=weights), changed(poisoned, weights=weights), poisoned)
    )
    assert bits(clean) == bits(ignored)
    assert bits(clean) != bits(counted)


ranked = jax.jit(rank_correlation)


def correlation(x, y, weights=None):
    weights = np.ones(len(x)) if weights is None else weights
    return float(ranked(*(jnp.asarray(v, jnp.float32) for v in (x, y, weights))))


@pytest.mark.parametrize("strength", [-1.0, 0.0, 0.3, 3.0])
def test_rank_correlation_is_spearmans_over_the_rows_with_weight(strength):
    rng = np.random.default_rng(0)
    x, noise = rng.standard_normal((2, 300))
    y = np.exp(strength * x + noise)  # ranks, and nothing else, are a Gaussian's
    weights = (rng.random(300) < 0.7).astype(float)
    expected = spearmanr(x[weights > 0], y[weights > 0]).statistic
    # What rows without weight hold does not matter.
    for poison in (0.0, 1e30, -1e30, np.inf, np.nan):
        masked = [np.where(weights > 0, values, poison) for values in (x, y)]
        assert correlation(*masked, weights) == pytest.approx(expected, abs=1e-5)
    assert abs(spearmanr(x, y).statistic - expected) > 1e-3


def test_rank_correlation_of_ties_is_spearmans():
    x, y = np.random.default_rng(1).integers(0, 5, (2, 300))
    y = x + y
    assert correlation(x, y) == pytest.approx(spearmanr(x, y).statistic, abs=1e-5)


def test_rank_correlation_at_its_ends():
    x = np.random.default_rng(2).standard_normal(300)
    assert correlation(x, x) == pytest.approx(1, abs=1e-6)
    assert correlation(x, np.exp(x)) == pytest.approx(1, abs=1e-6)
    assert correlation(x, -x) == pytest.approx(-1, abs=1e-6)
    rising = np.sort(x)
    # Nothing to rank by, or nothing to rank.
    assert correlation(np.full(300, 3.0), rising) == pytest.approx(0, abs=1e-6)
    assert correlation(rising, np.full(300, 3.0)) == pytest.approx(0, abs=1e-6)
    assert correlation(np.zeros(300), np.zeros(300)) == 0
    assert correlation(rising, rising, np.zeros(300)) == 0
    assert correlation(rising, rising, np.arange(300) == 7) == 0
