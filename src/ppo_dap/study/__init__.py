"""Comparisons of runs: statistics, figures, and the quickstart."""
