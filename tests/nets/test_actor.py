import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from ppo_dap.nets.actor import Actor, gaussian_kl, log_prob, tree_norm


def test_log_prob_is_scipys():
    rng = np.random.default_rng(0)
    actions, means = rng.standard_normal((2, 50, 3)).astype(np.float32)
    log_std = np.array([-1.0, 0.0, 0.7], np.float32)
    expected = norm.logpdf(actions, means, np.exp(log_std)).sum(-1)
    got = log_prob(jnp.asarray(actions), jnp.asarray(means), jnp.asarray(log_std))
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def kl(mean_p, std_p, mean_q, std_q):
    arrays = (mean_p, np.log(std_p), mean_q, np.log(std_q))
    return np.asarray(gaussian_kl(*(jnp.atleast_2d(jnp.asarray(a, jnp.float32)) for a in arrays)))


@pytest.mark.parametrize("case", [(0.0, 1.0, 0.5, 1.0), (0.3, 0.2, -0.1, 0.4), (1.0, 2.0, 1.0, 0.5)])
def test_kl_in_one_dimension_is_its_integral(case):
    p, q = norm(*case[:2]), norm(*case[2:])
    expected, _ = quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), *p.interval(1 - 1e-12))
    assert kl(*case)[0] == pytest.approx(expected, rel=1e-4)
    assert kl(*case[2:], *case[:2])[0] != pytest.approx(expected, rel=0.1) or case[1] == case[3]


def test_kl_in_more_dimensions_is_a_mean_over_samples():
    mean_p, std_p = np.array([0.2, -0.5, 0.0]), np.array([0.5, 1.0, 0.8])
    mean_q, std_q = np.array([0.0, -0.1, 0.3]), np.array([0.7, 0.9, 1.0])
    x = mean_p + std_p * np.random.default_rng(0).standard_normal((200_000, 3))
    log_ratio = (norm.logpdf(x, mean_p, std_p) - norm.logpdf(x, mean_q, std_q)).sum(-1)
    error = log_ratio.std() / len(x) ** 0.5
    assert kl(mean_p, std_p, mean_q, std_q)[0] == pytest.approx(log_ratio.mean(), abs=4 * error)


def test_kl_of_a_policy_with_itself_is_0():
    np.testing.assert_array_equal(kl([[0.3, -2.0]], [0.5, 0.1], [[0.3, -2.0]], [0.5, 0.1]), 0)


def test_initial_weights_are_orthogonal_with_ppos_gains():
    actor = Actor.create(np.random.default_rng(0), 5, 3, 16)
    for layer, gain in zip(actor.mlp.layers, (2**0.5, 2**0.5, 0.01), strict=True):
        weight = np.asarray(layer.weight, np.float64)
        rows, columns = weight.shape
        product = weight @ weight.T if rows <= columns else weight.T @ weight
        np.testing.assert_allclose(product, gain**2 * np.eye(min(rows, columns)), atol=2e-6 * max(1, gain**2))
        assert not np.any(layer.bias)
    np.testing.assert_array_equal(actor.log_std, np.zeros(3))


def test_tree_norm_is_the_norm_of_all_leaves():
    tree = {"a": jnp.array([3.0, 0.0]), "b": (jnp.array([[4.0]]), jnp.array(12.0))}
    assert float(tree_norm(tree)) == pytest.approx(13)
