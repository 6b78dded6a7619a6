"""Action priors p(a | s): what a prior is, the diffusion prior (Eq. 6), its samplers (Eq. 8) and its fit (Stage I)."""

from ppo_dap.priors.diffusion import DiffusionConfig
from ppo_dap.priors.fit import fit_prior
from ppo_dap.priors.prior import DiffusionPrior, Prior, load_prior

__all__ = ["DiffusionConfig", "DiffusionPrior", "Prior", "fit_prior", "load_prior"]
