"""Action priors p(a | s): what a prior is, the diffusion prior (Eq. 6), its samplers (Eq. 8) and its fit (Stage I)."""
