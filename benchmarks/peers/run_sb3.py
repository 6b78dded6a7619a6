"""Training speed of Stable-Baselines3's PPO on one MuJoCo task, on the CPU.

The first iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import torch
from common import arguments
from sb3_interface import measure
from stable_baselines3 import PPO

if __name__ == "__main__":
    measure(PPO, torch.nn.Tanh, arguments(__doc__), "sb3", "stable-baselines3")
