"""`ppo-dap bench`: what it all costs."""
