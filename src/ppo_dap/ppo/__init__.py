"""PPO (3.2, 3.3): rollouts, advantages, the clipped surrogate and the update. Knows nothing of priors or proposals."""
