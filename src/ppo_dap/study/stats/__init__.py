"""Statistics of runs (5.1.3), and runs compared."""
