"""Action priors p(a | s): what a prior is, its kinds, the samplers of Eq. 8 and the fit (Stage I)."""

from ppo_dap.priors.fit import fit_prior
from ppo_dap.priors.prior import Prior, load_prior
from ppo_dap.priors.random import random_prior

__all__ = ["Prior", "fit_prior", "load_prior", "random_prior"]
