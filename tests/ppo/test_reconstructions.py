"""What stands for ABPPO's and PPO-GC's objectives, against brute force, and PPO itself where a knob says so."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from ppo.ppo_made import changed, make_rows, orders_of, small_config
from ppo_dap.ppo.surrogate import (
    authentic_boundary_surrogate,
    authentic_bounds,
    centred_surrogate,
    clipped_surrogate,
    default_boundary_kl,
    generalised_clip_surrogate,
)
from ppo_dap.ppo.update import PPOState, Settings, improve_actor, ppo_loss

EPSILON = 0.2
RATIOS = np.array([0.01, 0.3, 0.79, 0.81, 1.0, 1.1, 1.19, 1.21, 1.7, 6.0])
ADVANTAGES = np.array([-2.0, -0.3, 0.0, 0.5, 3.0])
GRID = [(r, a) for r in RATIOS for a in ADVANTAGES]


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


def one_row(surrogate):
    """Value of a surrogate at numbers instead of rows, and its derivative in the first."""
    compiled = jax.jit(jax.value_and_grad(lambda *rows: surrogate(*rows, jnp.ones(1))))

    def at(*numbers):
        value, gradient = compiled(*(jnp.array([number]) for number in numbers))
        return float(value), float(gradient[0])

    return at


def relaxed_clip(ratio, advantage, slope):
    """Branch by branch, as it is written down."""
    bound = ratio
    if ratio > 1 + EPSILON:
        bound = 1 + EPSILON + slope * (ratio - 1 - EPSILON)
    elif ratio < 1 - EPSILON:
        bound = 1 - EPSILON + slope * (ratio - 1 + EPSILON)
    return min(ratio * advantage, bound * advantage)


@pytest.mark.parametrize("slope", [-1.0, -0.3, 0.0, 0.1, 0.3, 1.0])
def test_generalised_clip_on_a_grid(float64, slope):
    compiled = one_row(lambda r, a, one: generalised_clip_surrogate(r, a, one, EPSILON, slope))
    for ratio, advantage in GRID:
        value, gradient = compiled(ratio, advantage)
        assert value == pytest.approx(relaxed_clip(ratio, advantage, slope), rel=1e-12)
        numeric = (relaxed_clip(ratio + 1e-6, advantage, slope) - relaxed_clip(ratio - 1e-6, advantage, slope)) / 2e-6
        assert gradient == pytest.approx(numeric, abs=1e-8)


def test_the_gradient_outside_the_range_is_the_slopes_share():
    """Planted: another slope is another gradient; a row that got worse is not clipped at any slope."""
    for slope, expected in ((0.1, 0.2), (0.3, 0.6), (-0.3, -0.6)):
        row = one_row(lambda r, a, one, s=slope: generalised_clip_surrogate(r, a, one, EPSILON, s))
        assert row(1.5, 2.0)[1] == pytest.approx(expected)
        assert row(0.5, 2.0)[1] == pytest.approx(2.0)


def test_slope_1_is_the_unclipped_surrogate(float64):
    ratio, advantages = (np.array(x) for x in zip(*GRID, strict=True))
    weights = np.arange(len(GRID)) % 3 > 0
    rows = (jnp.asarray(x, float) for x in (ratio, advantages, weights))
    value, gradient = jax.value_and_grad(lambda *rows: generalised_clip_surrogate(*rows, EPSILON, 1.0))(*rows)
    assert float(value) == pytest.approx((ratio * advantages)[weights].mean(), rel=1e-12)
    np.testing.assert_allclose(gradient, advantages * weights / weights.sum(), atol=1e-15)


SPREAD, MEAN = np.array([0.4, 1.7]), np.array([0.3, -2.0])


def searched_bounds(action, boundary_kl):
    """Smallest and largest density ratio over shifts of the mean, on a fine grid of the ball of that KL."""
    radii = np.linspace(0, math.sqrt(2 * boundary_kl), 101)
    angles = np.linspace(0, 2 * math.pi, 721)
    shifts = np.stack([np.outer(radii, np.cos(angles)), np.outer(radii, np.sin(angles))], axis=-1)
    moved, kept = ((action - mean) ** 2 / (2 * SPREAD**2) for mean in (MEAN + SPREAD * shifts, MEAN))
    ratios = np.exp((kept - moved).sum(-1))
    return ratios.min(), ratios.max()


@pytest.mark.parametrize("boundary_kl", [1e-3, 0.0115, 0.3, 2.0])
def test_authentic_bounds_are_the_extremes_over_shifts_of_the_mean(boundary_kl):
    rng = np.random.default_rng(0)
    z = np.concatenate([rng.standard_normal((12, 2)), [[0, 0], [1e-3, 0], [3, -3]]])
    lower, upper = authentic_bounds(jnp.asarray(z), boundary_kl)
    expected = [searched_bounds(MEAN + SPREAD * row, boundary_kl) for row in z]
    np.testing.assert_allclose(lower, [low for low, _ in expected], rtol=2e-4)
    np.testing.assert_allclose(upper, [high for _, high in expected], rtol=2e-4)
    assert np.all(np.asarray(lower) < 1)
    assert np.all(np.asarray(upper) >= 1)


def test_authentic_boundary_on_a_grid(float64):
    def reference(ratio, advantage, lower, upper):
        bounded = lower if ratio < lower else upper if ratio > upper else ratio
        return min(ratio * advantage, bounded * advantage)

    compiled = one_row(lambda r, a, low, up, one: authentic_boundary_surrogate(r, a, one, low, up))
    for low, up in ((0.9, 1.05), (0.5, 3.0), (0.97, 1.0)):
        for ratio, advantage in GRID:
            if ratio == up:
                continue  # a kink
            row = (ratio, advantage, low, up)
            value, gradient = compiled(*row)
            assert value == pytest.approx(reference(*row), rel=1e-12)
            slope = (reference(ratio + 1e-6, *row[1:]) - reference(ratio - 1e-6, *row[1:])) / 2e-6
            assert gradient == pytest.approx(slope, abs=1e-8)


def test_centred_surrogate_on_a_grid(float64):
    def reference(ratio, centre, advantage):
        bounded = max(centre - EPSILON, min(ratio, centre + EPSILON))
        return min(ratio * advantage, bounded * advantage)

    compiled = one_row(lambda r, c, a, one: centred_surrogate(r, c, a, one, EPSILON))
    for centre in (0.6, 1.0, 1.45):
        for ratio, advantage in GRID:
            row = (ratio, centre, advantage)
            value, gradient = compiled(*row)
            assert value == pytest.approx(reference(*row), rel=1e-12)
            slope = (reference(ratio + 1e-6, *row[1:]) - reference(ratio - 1e-6, *row[1:])) / 2e-6
            assert gradient == pytest.approx(slope, abs=1e-8)


def test_a_centre_of_1_is_eq_5():
    ratio, advantages = (jnp.asarray(x, jnp.float32) for x in zip(*GRID, strict=True))
    ones = jnp.ones(len(GRID))
    centred = centred_surrogate(ratio, ones, advantages, ones, EPSILON)
    assert float(centred) == float(clipped_surrogate(ratio, advantages, ones, EPSILON))
    assert float(centred_surrogate(ratio, 2 * ones, advantages, ones, EPSILON)) != float(centred)


# The table of the default trust region, to two digits of which Monte Carlo left the last one open.
TABLE = {2: 0.0115, 3: 0.0068, 6: 0.0031, 7: 0.0026, 8: 0.0023, 17: 0.0010}


@pytest.mark.parametrize(("action_size", "expected"), TABLE.items())
def test_default_trust_region_against_the_table(action_size, expected):
    assert default_boundary_kl(action_size, EPSILON) == pytest.approx(expected, rel=0.03)


def test_default_trust_region_in_closed_form():
    """In one dimension the mean bound is 1 + sqrt(2/pi) rho, in two 1 + rho sqrt(pi/2) + rho^2 / 2."""
    for epsilon in (0.01, 0.2, 3.0):
        assert default_boundary_kl(1, epsilon) == pytest.approx((epsilon * math.sqrt(math.pi / 2)) ** 2 / 2, rel=1e-8)
        half = math.sqrt(math.pi / 2)
        radius = -half + math.sqrt(half**2 + 2 * epsilon)
        assert default_boundary_kl(2, epsilon) == pytest.approx(radius**2 / 2, rel=1e-8)


@pytest.mark.parametrize("action_size", [3, 8, 17])
def test_mean_upper_bound_over_random_actions_is_1_plus_epsilon(action_size):
    z = np.random.default_rng(0).standard_normal((200_000, action_size)).astype(np.float32)
    bounds = authentic_bounds(jnp.asarray(z), default_boundary_kl(action_size, EPSILON))
    lower, upper = (np.asarray(bound, np.float64) for bound in bounds)
    assert upper.mean() == pytest.approx(1 + EPSILON, abs=4 * upper.std() / math.sqrt(len(z)))
    assert 0.81 < lower.mean() < 0.84


# On a real update.

SIZES = small_config()
STATE = PPOState.create(np.random.default_rng(0), 3, 2, SIZES.hidden_size)
ROWS = make_rows(STATE.actor)
ORDERS = orders_of(SIZES, seed=1)
LIMITLESS = Settings(jnp.float32(1e-2), jnp.float32(np.inf), jnp.array(False))


@functools.cache
def program(**options):
    return jax.jit(functools.partial(improve_actor, ppo=small_config(**options)))


def improved(rows=ROWS, **options):
    """Actor and optimizer after a real update. (The loss that is logged is summed up in another order in each program:
    its last bit is not compared.)
    """
    return program(**options)(STATE.actor, STATE.actor_optimizer, rows, (), ORDERS, LIMITLESS)[:2]


def assert_same_bits(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def differ(first, second):
    return any(np.any(a != b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))


@pytest.mark.as_shipped
def test_slope_0_is_ppo_bit_for_bit():
    ppo = improved()
    assert_same_bits(improved(surrogate="generalised_clip", clip_slope=0.0), ppo)
    assert differ(improved(surrogate="generalised_clip", clip_slope=0.1)[0], ppo[0])
    assert differ(improved(clip_epsilon=1e6)[0], ppo[0])  # clipping does bite on these rows


def test_slope_1_learns_as_without_a_clip():
    free, relaxed = (
        improved(clip_epsilon=1e6)[0],
        improved(surrogate="generalised_clip", clip_slope=1.0)[0],
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), free, relaxed)


def far_rows():
    """Rows whose actions are all far from the old mean, where no bound on the spread's change bites either."""
    rng = np.random.default_rng(5)
    z = rng.uniform(2.5, 3.5, (64, 2)) * rng.choice([-1, 1], (64, 2))
    log_probs = norm.logpdf(z).sum(-1)
    return changed(
        ROWS,
        actions=ROWS.old_means + jnp.asarray(z, jnp.float32),
        old_log_probs=jnp.asarray(log_probs, jnp.float32),
    )


@pytest.mark.as_shipped
def test_a_boundless_trust_region_is_ppo_without_a_clip_bit_for_bit():
    rows = far_rows()
    free = improved(rows, clip_epsilon=1e6)
    assert_same_bits(improved(rows, surrogate="authentic_boundary", boundary_kl=1e6), free)
    assert differ(improved(rows, surrogate="authentic_boundary", boundary_kl=1e-3)[0], free[0])
    assert differ(improved(rows)[0], free[0])


def test_the_default_trust_region_is_the_one_of_the_actions_dimension():
    moved = changed(STATE.actor, log_std=STATE.actor.log_std - 0.2)

    def loss(**options):
        ppo = small_config(surrogate="authentic_boundary", **options)
        return float(ppo_loss(moved, ROWS, STATE.actor.log_std, ppo=ppo)[0])

    assert loss() == loss(boundary_kl=default_boundary_kl(2, EPSILON)) != loss(boundary_kl=default_boundary_kl(3, 0.2))
    assert loss(clip_epsilon=0.5) == loss(boundary_kl=default_boundary_kl(2, 0.5)) != loss()


def test_bounds_are_those_of_the_old_policys_spread():
    """One step from the old policy with another spread: the loss is the brute-force one with z in the old spread."""
    actor = STATE.actor
    old_log_std = np.array([-0.7, 0.4], np.float32)
    z = np.asarray(ROWS.actions - ROWS.old_means) * np.exp(-old_log_std)
    ppo = small_config(surrogate="authentic_boundary", boundary_kl=0.05)
    old = norm.logpdf(z).sum(-1) - old_log_std.sum()
    rows = changed(ROWS, old_log_probs=jnp.asarray(old, jnp.float32))
    loss = jax.jit(lambda actor: ppo_loss(actor, rows, jnp.asarray(old_log_std), ppo=ppo)[0])(actor)
    ratio = np.exp(norm.logpdf(np.asarray(ROWS.actions - ROWS.old_means)).sum(-1) - old)
    distance, radius = np.sqrt((z**2).sum(-1)), math.sqrt(0.1)
    upper = np.exp(np.where(distance < radius, distance**2 / 2, radius * distance - 0.05))
    bounded = np.clip(ratio, np.exp(-radius * distance - 0.05), upper)
    advantages = np.asarray(ROWS.advantages)
    advantages = (advantages - advantages.mean()) / advantages.std()
    assert float(loss) == pytest.approx(-np.minimum(ratio * advantages, bounded * advantages).mean(), rel=1e-4)
    assert np.mean((ratio > upper) & (advantages > 0)) > 0.05


@pytest.mark.parametrize("surrogate", ["authentic_boundary", "generalised_clip"])
def test_masked_rows_move_nothing(surrogate):
    masked = np.arange(64) % 5 == 0
    half = changed(ROWS, weights=jnp.asarray(~masked, jnp.float32))
    garbage = {name: np.array(getattr(half, name)) for name in ("actions", "old_means", "old_log_probs", "advantages")}
    for value in garbage.values():
        value[masked] = 1e6
    garbled = changed(half, **{name: jnp.asarray(value) for name, value in garbage.items()})
    learned = improved(half, surrogate=surrogate)
    assert_same_bits(improved(garbled, surrogate=surrogate), learned)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learned))
