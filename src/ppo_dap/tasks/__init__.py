"""Tasks: what a Gymnasium id offers, and one interface to step many copies of it."""

from ppo_dap.tasks.catalogue import CATALOGUE, TaskSpec, describe
from ppo_dap.tasks.vector import Transition, VectorEnv, make_vector_env

__all__ = ["CATALOGUE", "TaskSpec", "Transition", "VectorEnv", "describe", "make_vector_env"]
