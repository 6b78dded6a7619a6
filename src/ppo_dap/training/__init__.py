"""Stage II: Algorithm 1, and what makes a run of it: warm start, evaluation, checkpoints, recording."""
