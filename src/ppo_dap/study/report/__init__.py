"""`ppo-dap report`: any set of runs as one page."""
