import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from scipy.spatial import KDTree
from truths import TwoModes

from ppo_dap.dap.dataflow import trace
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs
from ppo_dap.prior_config import RetrievalConfig
from ppo_dap.priors import fit_prior, load_prior
from ppo_dap.priors import retrieval as module
from ppo_dap.priors.network import Network, Rows, TrainedNetwork
from ppo_dap.priors.retrieval import Memory
from ppo_dap.priors.samplers import Solver

SOLVER = Solver("ancestral", 1)
# Correlated columns of very different spreads, one of which never changes.
MIX = np.random.default_rng(7).normal(size=(5, 6)) * np.array([1e-2, 1.0, 50.0, 3.0, 0.3, 0.0])
SHIFT = np.array([1.0, -2.0, 300.0, 0.0, 5.0, 4.0])


def states_of(rng, rows):
    return (rng.normal(size=(rows, 5)) @ MIX + SHIFT).astype(np.float32)


def memory_of(observations, condition=None, **options):
    """A memory whose actions are the numbers of its rows, so that what it retrieves names itself."""
    rows = len(observations)
    condition = np.zeros((rows, 0)) if condition is None else condition
    numbers = np.arange(rows)[:, None]
    train = Rows(*(jnp.asarray(a, jnp.float32) for a in (observations, condition, numbers)))
    held_out = Rows(*(a[:20] for a in train))
    return Memory.build(train, held_out, RetrievalConfig(**options), np.random.default_rng(0))


def retrieved(memory, queries, num, condition=None):
    condition = np.zeros((len(queries), 0)) if condition is None else condition
    noise = jnp.zeros(memory.noise_shape(SOLVER, len(queries), num))
    inputs = jnp.asarray(queries, jnp.float32), jnp.asarray(condition, jnp.float32)
    actions, displacement = jax.jit(lambda *a: memory.sample(*a, SOLVER))(*inputs, noise)
    assert actions.shape == (len(queries), num, 1)
    assert displacement.shape == (len(queries), num)
    assert not np.any(displacement)
    return np.asarray(actions)[..., 0].astype(int)


def standard(observations, queries, whitening):
    """Both in standardised columns, or in their principal components with variance 1, by singular values."""
    wide = np.asarray(observations, np.float64)
    moving = np.ptp(wide, axis=0) > 1e-5
    z, q = ((np.asarray(a, np.float64)[:, moving] - wide[:, moving].mean(0)) for a in (wide, queries))
    z, q = z / wide[:, moving].std(0), q / wide[:, moving].std(0)
    if whitening == "columns":
        return z, q
    _, values, directions = np.linalg.svd(z, full_matrices=False)
    return tuple(a @ directions.T / values * np.sqrt(len(z)) for a in (z, q))


@pytest.mark.parametrize("whitening", ["columns", "covariance"])
@pytest.mark.parametrize("rows", [11, 64, 1000, module.CHUNK + 77])
def test_the_neighbours_are_those_of_a_k_d_tree(whitening, rows):
    rng = np.random.default_rng(rows)
    observations, queries = states_of(rng, rows), states_of(rng, 60)
    memory, summary = memory_of(observations, whitening=whitening)
    keys, points = standard(observations, queries, whitening)
    found = retrieved(memory, queries, 10)
    distances, expected = KDTree(keys).query(points, k=10)
    assert all(len(set(row)) == 10 for row in found.tolist())
    # Nearest first, and the same rows but for those that are equally near in float32.
    ours = np.linalg.norm(keys[found] - points[:, None], axis=-1)
    np.testing.assert_allclose(ours, distances, rtol=1e-4, atol=1e-5)
    assert np.mean(found == expected) > 0.99
    assert (summary["rows"], summary["of_rows"], summary["steps"]) == (rows, rows, 0)


def test_states_that_lie_close_together_are_told_apart():
    """The product alone would lose them: beside a norm of 9, a distance of 1e-4 is below float32's last digit."""
    rng = np.random.default_rng(0)
    crowd = 9 + 1e-4 * rng.normal(size=(300, 3))
    observations = np.concatenate([rng.normal(size=(30_000, 3)) * np.sqrt(3), crowd]).astype(np.float32)
    queries = (9 + 1e-4 * rng.normal(size=(20, 3))).astype(np.float32)
    keys, points = standard(observations, queries, "columns")
    _, expected = KDTree(keys).query(points, k=1)
    found = retrieved(memory_of(observations)[0], queries, 10)
    assert np.mean(found[:, 0] == expected) > 0.8


def test_a_search_that_looks_at_too_few_blocks_is_found(monkeypatch):
    """The planted fault: one block fewer than proposals."""
    rng = np.random.default_rng(3)
    observations, queries = states_of(rng, 3000), states_of(rng, 60)
    _, expected = KDTree(standard(observations, queries, "columns")[0]).query(
        standard(observations, queries, "columns")[1], k=10
    )
    memory, _ = memory_of(observations)
    top_k = jax.lax.top_k
    monkeypatch.setattr(jax.lax, "top_k", lambda a, k: top_k(a, k if a.shape[1] >= 64 else min(k, 4)))
    assert np.mean(retrieved(memory, queries, 10) == expected) < 0.99


def test_whitening_makes_columns_count_the_same():
    rng = np.random.default_rng(1)
    observations = rng.normal(size=(500, 2)) * np.array([1.0, 1e4])
    near = observations[7] + np.array([0.0, 100.0])  # 0.01 of its column's spread
    assert retrieved(memory_of(observations)[0], near[None], 1)[0, 0] == 7


def test_the_condition_counts_where_it_is_known_and_only_there():
    rng = np.random.default_rng(2)
    observations, queries = rng.normal(size=(2000, 2)), rng.normal(size=(40, 2))
    returns = rng.normal(size=2000)
    condition = np.stack([returns, np.ones(2000)], axis=1)
    weight = 2.0
    memory, _ = memory_of(observations, condition, condition_on="return", return_weight=weight)
    keys, points = standard(observations, queries, "columns")
    joint = KDTree(np.concatenate([keys, weight * returns[:, None]], axis=1))
    _, expected = joint.query(np.concatenate([points, np.full((40, 1), weight * 1.5)], axis=1), k=5)
    asked = retrieved(memory, queries, 5, np.tile([1.5, 1.0], (40, 1)))
    assert np.mean(asked == expected) > 0.99
    _, plain = KDTree(keys).query(points, k=5)
    assert np.mean(retrieved(memory, queries, 5, np.zeros((40, 2))) == plain) > 0.99
    assert returns[asked].mean() > 1.0 > 0.3 > returns[plain].mean()


def test_a_cap_on_the_rows_draws_them_by_seed():
    rng = np.random.default_rng(4)
    observations = states_of(rng, 1000)
    memory, summary = memory_of(observations, max_rows=100)
    assert (summary["rows"], summary["of_rows"]) == (100, 1000)
    kept = np.asarray(memory.actions)[:, 0].astype(int)
    assert len(set(kept.tolist())) == 100
    assert kept.max() > 800  # not the first ones
    np.testing.assert_array_equal(kept[retrieved_rows(memory, observations[kept])], kept)


def retrieved_rows(memory, queries):
    nearest = jax.jit(lambda states: memory.nearest(states, jnp.zeros((len(queries), 0)), 1))
    return np.asarray(nearest(jnp.asarray(queries)))[:, 0]


def test_more_proposals_than_rows_are_refused():
    memory, _ = memory_of(states_of(np.random.default_rng(0), 5))
    with pytest.raises(InputError, match="10 proposals a state asked of a retrieval prior with 5 rows"):
        retrieved(memory, np.zeros((2, 6)), 10)


@pytest.fixture(scope="module")
def prior(logs):
    return fit_prior(logs, "retrieval", seed=3)


def test_both_modes_are_kept_with_their_share(prior):
    states = np.random.default_rng(1).uniform(-0.9, 0.9, (400, 2))
    actions = np.asarray(prior.sample(states, jax.random.key(0), 10), np.float64)
    scaled = (actions - [0.0, 0.5]) / [2.0, 0.5]
    means = TwoModes().means(states)[:, None]
    distances = np.linalg.norm(scaled[:, :, None] - means, axis=-1)
    # 18,000 rows' modes are drawn once and 400 states share many of them: a share of 0.3 within 4 times 0.0072, the
    # spread that 4,000 independent ones would have.
    assert np.mean(distances[..., 0] < distances[..., 1]) == pytest.approx(0.3, abs=0.03)
    # Each action is at its own mode: the noise of 0.08 in two dimensions, never between modes that are 1 apart.
    assert np.sqrt(np.mean(distances.min(-1) ** 2)) == pytest.approx(0.08 * np.sqrt(2), rel=0.1)
    shares = np.mean(distances[..., 0] < distances[..., 1], axis=1)
    assert np.mean((shares > 0) & (shares < 1)) > 0.9  # 1 - 0.3^10 - 0.7^10 = 0.97


def test_the_held_out_loss_is_that_of_the_mean_of_ten(prior):
    """Two modes about 1.07 apart: variance 0.3 0.7 d^2 + 2 sd^2, of which the mean of ten adds a tenth."""
    states = np.random.default_rng(0).uniform(-1, 1, (100_000, 2))
    first, second = np.moveaxis(TwoModes().means(states), 1, 0)
    variance = 0.21 * np.mean(np.sum((first - second) ** 2, axis=1)) + 2 * 0.08**2
    assert prior.training["validation_loss"] == pytest.approx(1.1 * variance, rel=0.12)


def test_samples_are_logged_actions_within_the_box(prior, logs):
    states = np.random.default_rng(0).normal(size=(30, 2)) * 100
    actions = np.asarray(prior.sample(states, jax.random.key(0), 10))
    assert actions.shape == (30, 10, 2)
    assert np.all((actions >= prior.action_low) & (actions <= prior.action_high))
    distances, _ = KDTree(logs.actions).query(actions.reshape(-1, 2))
    assert np.max(distances) < 1e-6


def test_same_seed_same_bits(logs, prior):
    again, other = (fit_prior(logs, "retrieval", seed=seed) for seed in (3, 4))
    leaves = [jax.tree.leaves(p.network) for p in (prior, again, other)]
    assert all(np.array_equal(a, b) for a, b in zip(leaves[0], leaves[1], strict=True))
    assert not np.array_equal(leaves[0][1], leaves[2][1])
    states = np.random.default_rng(0).uniform(-1, 1, (7, 2))
    one, two = (p.sample(states, jax.random.key(1), 5) for p in (prior, again))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("condition_on", ["none", "return"])
def test_a_loaded_prior_is_the_same_prior(logs, tmp_path, condition_on):
    rewards = np.random.default_rng(0).normal(size=logs.num_rows)
    made = fit_prior(dataclasses.replace(logs, rewards=rewards), "retrieval", condition_on=condition_on, max_rows=5000)
    made.save(tmp_path / "prior")
    loaded = load_prior(tmp_path / "prior")
    assert (loaded.kind, loaded.config, loaded.training) == ("retrieval", made.config, made.training)
    for one, two in zip(jax.tree.leaves(made.network), jax.tree.leaves(loaded.network), strict=True):
        np.testing.assert_array_equal(one, two)
    states = np.random.default_rng(0).uniform(-1, 1, (7, 2))
    asked = "top" if condition_on == "return" else "none"
    one, two = (p.sample(states, jax.random.key(1), 5, asked) for p in (made, loaded))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("name", ["actions", "keys", "whitener"])
def test_a_file_with_an_array_of_another_size_or_none_is_refused(prior, tmp_path, name):
    path = tmp_path / "prior"
    prior.save(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        header = file.metadata()
    whole = safetensors.numpy.load(path.read_bytes())
    for planted in ({f"network.{name}": whole[f"network.{name}"][:1].copy()}, {}):
        rest = {key: value for key, value in whole.items() if key != f"network.{name}"}
        path.write_bytes(safetensors.numpy.save({**rest, **planted}, header))
        with pytest.raises(InputError, match=r"has .* for network\.\w+ where") as caught:
            load_prior(path)
        assert "\n" not in str(caught.value)


def test_returns_lead_to_the_episodes_that_had_them():
    """Two kinds of episodes with the same states: asked for the top return, the better one's actions come back."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (4000, 2))
    good = np.repeat(np.arange(40) % 2, 100)
    logs = Logs(
        observations=states,
        actions=(0.5 * (2 * good - 1))[:, None],
        episode_ends=np.arange(1, 4001) % 100 == 0,
        rewards=good.astype(float),
        action_low=-np.ones(1),
        action_high=np.ones(1),
    )
    prior = fit_prior(logs, "retrieval", condition_on="return")
    queries = rng.uniform(-0.9, 0.9, (50, 2))
    top, plain = (np.asarray(prior.sample(queries, jax.random.key(0), 10, asked)) for asked in ("top", "none"))
    assert np.all(top == 0.5)
    assert np.mean(plain) == pytest.approx(0.0, abs=0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_rows": 0}, "max_rows must be a number above 0, not 0"),
        ({"return_weight": -1.0}, "return_weight must be a number above 0"),
        ({"validation_fraction": 1.0}, "validation_fraction must be below 1"),
        ({"batch_size": 3}, "unknown option of the retrieval prior 'batch_size'"),
    ],
)
def test_impossible_settings_are_refused(logs, options, message):
    with pytest.raises(InputError, match=message):
        fit_prior(logs, "retrieval", **options)


def test_the_traced_program_shows_what_the_actions_depend_on():
    """The proof by data flow reads the program: whatever is retrieved comes from arrays that it can see."""
    rng = np.random.default_rng(0)
    condition = np.ones((300, 2))
    memory, _ = memory_of(states_of(rng, 300), condition, condition_on="return")
    arrays = {name: getattr(memory, name) for name in ("keys", "actions", "observation_mean", "whitener")}

    def sample(observations, condition, noise, **arrays):
        actions, displacement = Memory(**arrays, config=memory.config).sample(observations, condition, noise, SOLVER)
        return {"actions": actions, "displacement": displacement}

    inputs = {"observations": jnp.zeros((3, 6)), "condition": jnp.ones((3, 2)), "noise": jnp.zeros((3, 4, 0))}
    traced = trace(sample, {**inputs, **arrays})
    flow = traced.flow()
    assert flow.outputs == {"actions": {"observations", "condition", *arrays}, "displacement": set()}
    assert "callback" not in str(traced.jaxpr)


def test_a_memory_is_a_network_that_is_not_trained(prior):
    assert isinstance(prior.network, Network)
    assert not isinstance(prior.network, TrainedNetwork)
