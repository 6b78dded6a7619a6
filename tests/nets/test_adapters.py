import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ppo_dap.errors import InputError
from ppo_dap.nets.adapters import Adapters, LoRA, adapter_norm, init_adapters, merge
from ppo_dap.nets.mlp import MLP
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors.diffusion import Denoiser, LossDraws, denoising_loss

CONFIG = DiffusionConfig(width=32, depth=2)
KINDS = ["lora", "bottleneck"]


@pytest.fixture(scope="module")
def denoiser():
    moments = jnp.zeros(3), jnp.ones(3), jnp.asarray(0.5)
    return Denoiser.create(np.random.default_rng(0), CONFIG, *moments, 2)


def rows(n=64):
    keys = jax.random.split(jax.random.key(1))
    return jax.random.normal(keys[0], (n, 3)), jnp.zeros((n, 0)), 0.3 * jax.random.normal(keys[1], (n, 2))


@jax.jit
def _loss_and_gradient(adapters, denoiser, draws):
    return jax.value_and_grad(lambda a: denoising_loss(denoiser, a, *rows(), draws, CONFIG))(adapters)


def loss_and_gradient(adapters, denoiser, seed):
    return _loss_and_gradient(adapters, denoiser, LossDraws.make(np.random.default_rng(seed), 64, 2))


def adapted(denoiser, kind, steps, learning_rate=1e-2):
    """Adapters after `steps` steps of L_PET with the optimizer on the adapters alone, as online."""
    adapters = init_adapters(np.random.default_rng(2), denoiser, kind, 4)
    optimizer = optax.adam(learning_rate)
    state = optimizer.init(adapters)
    for i in range(steps):
        _, gradient = loss_and_gradient(adapters, denoiser, i)
        updates, state = optimizer.update(gradient, state)
        adapters = optax.apply_updates(adapters, updates)
    return adapters


@pytest.mark.parametrize("kind", KINDS)
def test_adapters_start_as_an_exact_identity(denoiser, kind):
    adapters = init_adapters(np.random.default_rng(2), denoiser, kind, 4)
    x, embedding = jax.random.normal(jax.random.key(4), (64, 5, 2)), denoiser.embed(*rows()[:2])
    # All inputs are arguments: XLA evaluates what it can fold with another program, and other last bits.
    forward = jax.jit(lambda d, x, e, sigma, a: d(x, e, sigma, a))
    inputs = denoiser, x, embedding, jnp.asarray(0.3)
    np.testing.assert_array_equal(forward(*inputs, adapters), forward(*inputs, None))
    merged, _ = merge(denoiser, adapters)
    assert all(np.array_equal(m.weight, w.weight) for m, w in zip(merged.hidden, denoiser.hidden, strict=True))
    assert float(adapter_norm(adapters)) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_one_factor_learns_at_once_and_both_after_one_step(denoiser, kind):
    adapters = init_adapters(np.random.default_rng(2), denoiser, kind, 4)
    _, first = loss_and_gradient(adapters, denoiser, 0)
    assert all(np.any(layer.up) and not np.any(layer.down) for layer in first.layers)
    _, second = loss_and_gradient(adapted(denoiser, kind, 1), denoiser, 1)
    assert all(np.any(layer.up) and np.any(layer.down) for layer in second.layers)


@pytest.mark.parametrize("kind", KINDS)
def test_pet_lowers_its_loss(denoiser, kind):
    start, end = (adapted(denoiser, kind, steps) for steps in (0, 60))
    before, after = (float(loss_and_gradient(a, denoiser, 99)[0]) for a in (start, end))
    assert after < 0.97 * before
    assert float(adapter_norm(end)) > 0.01


def test_merged_lora_is_the_same_network(denoiser):
    adapters = adapted(denoiser, "lora", 20)
    merged, left = merge(denoiser, adapters)
    assert left is None
    x, embedding = jax.random.normal(jax.random.key(4), (64, 5, 2)), denoiser.embed(*rows()[:2])
    attached = np.asarray(denoiser(x, embedding, jnp.asarray(0.3), adapters))
    np.testing.assert_allclose(merged(x, embedding, jnp.asarray(0.3)), attached, rtol=1e-4, atol=1e-5)
    assert np.abs(attached - denoiser(x, embedding, jnp.asarray(0.3))).max() > 1e-2


def test_a_bottleneck_stays_attached(denoiser):
    adapters = adapted(denoiser, "bottleneck", 1)
    backbone, left = merge(denoiser, adapters)
    assert backbone is denoiser
    assert left is adapters
    assert merge(denoiser, None) == (denoiser, None)


def test_adapter_norm_is_the_norm_of_the_change(denoiser):
    adapters = adapted(denoiser, "lora", 3)
    merged, _ = merge(denoiser, adapters)
    moved = [m.weight - w.weight for m, w in zip(merged.hidden, denoiser.hidden, strict=True)]
    assert float(adapter_norm(adapters)) == pytest.approx(np.linalg.norm(np.stack(moved)), rel=1e-4)
    assert float(adapter_norm(Adapters((LoRA(jnp.asarray([[3.0]]), jnp.asarray([[2.0]])),)))) == 6


def test_unknown_kind(denoiser):
    with pytest.raises(InputError, match="did you mean 'lora'"):
        init_adapters(np.random.default_rng(0), denoiser, "lorra", 4)


def test_mlp_starts_orthogonal_with_its_final_gain():
    net = MLP.create(np.random.default_rng(0), (8, 8, 8), "tanh", 0.01)
    for layer, gain in zip(net.layers, (2**0.5, 0.01), strict=True):
        np.testing.assert_allclose(layer.weight @ layer.weight.T, gain**2 * np.eye(8), atol=1e-5)
        assert not np.any(layer.bias)


def test_mlp_equals_plain_numpy():
    net = MLP.create(np.random.default_rng(0), (3, 5, 2), "silu", 1.0)
    x = np.random.default_rng(0).standard_normal((4, 6, 3)).astype(np.float32)
    hidden = x @ np.asarray(net.layers[0].weight).T
    expected = (hidden / (1 + np.exp(-hidden))) @ np.asarray(net.layers[1].weight).T
    np.testing.assert_allclose(net(jnp.asarray(x)), expected, rtol=1e-4, atol=1e-5)
