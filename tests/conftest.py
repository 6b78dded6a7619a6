"""What holds in every test: one core for XLA (the same bits everywhere), no display, no silent broadcasting."""

import os

os.environ.setdefault("NPROC", "1")  # XLA reads it when it starts; subprocesses inherit it
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import mujoco

jax.config.update("jax_numpy_rank_promotion", "raise")
mujoco.set_mju_user_warning(lambda text: None)  # else every warning is appended to MUJOCO_LOG.TXT in the working folder
