"""Distributions whose denoiser and samples are known without any network, and a two-sample test."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist


@dataclass(frozen=True)
class TwoModes:
    """a | s: N(m_0(s), sd^2 I) with probability `share`, else N(m_1(s), sd^2 I); s and a have two dimensions."""

    sd: float = 0.08
    share: float = 0.3

    def means(self, states):
        """(..., 2, 2): mode, then action."""
        first = np.array([0.45, -0.3]) + 0.2 * states
        second = np.array([-0.4, 0.35]) + 0.15 * states[..., ::-1]
        return np.stack([first, second], axis=-2)

    def sample(self, states, k, rng):
        mode = (rng.random((len(states), k)) > self.share).astype(int)
        means = np.take_along_axis(self.means(states)[:, None], mode[..., None, None], axis=2)[:, :, 0]
        return means + self.sd * rng.standard_normal(means.shape)

    def denoiser(self, states):
        """E[a | x, sigma] from Bayes' rule, as a function of (x, sigma) that JAX can trace."""
        import jax
        import jax.numpy as jnp

        means = jnp.asarray(self.means(states), jnp.float32)[:, None]
        log_share = jnp.log(jnp.asarray([self.share, 1 - self.share]))[None, None]

        def denoise(x, sigma):
            spread = self.sd**2 + sigma**2
            logits = log_share - jnp.sum((x[:, :, None] - means) ** 2, axis=-1) / (2 * spread)
            expected = (self.sd**2 * x[:, :, None] + sigma**2 * means) / spread
            return jnp.sum(jax.nn.softmax(logits)[..., None] * expected, axis=2)

        return denoise


def energy(x, y):
    """Energy distance of two samples, unbiased: about 0 when they come from one distribution."""
    n, m = len(x), len(y)
    return 2 * cdist(x, y).mean() - cdist(x, x).sum() / (n * (n - 1)) - cdist(y, y).sum() / (m * (m - 1))


def two_sample_p(x, y, permutations=199, seed=0):
    """p-value of the permutation test on the energy distance, for samples of one size."""
    n, rng = len(x), np.random.default_rng(seed)
    every = cdist(*(np.concatenate([x, y]),) * 2)

    labels = np.concatenate([np.ones(n), -np.ones(n)])
    signs = np.stack([labels] + [rng.permutation(labels) for _ in range(permutations)])
    statistics = -np.sum((signs @ every) * signs, axis=1)  # the first is that of the samples as they are
    return np.mean(statistics >= statistics[0])


def moment_matched(x, rng):
    """A Gaussian sample with the moments of `x`: what a prior without modes would give."""
    return rng.multivariate_normal(x.mean(0), np.cov(x.T), size=len(x))
