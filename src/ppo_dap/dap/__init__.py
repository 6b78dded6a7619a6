"""PPO-DAP (section 4): value-guided proposals, the actor objective, adaptation of the prior, and the audits."""
