"""A policy of Stable-Baselines3 meets a reversed motor, with and without correction.

    python examples/policies/stable_baselines.py

`pip install stable-baselines3` first. The policy is trained on the healthy inverted pendulum.
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformAction
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from afm_rl import ActionFlowWrapper

TASK = "InvertedPendulum-v5"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30_000, help="of training")
    parser.add_argument("--episodes", type=int, default=10)
    args = parser.parse_args()
    torch.set_num_threads(1)
    policy = PPO("MlpPolicy", gymnasium.make(TASK), seed=0, device="cpu").learn(args.steps)
    robots = {
        "healthy": gymnasium.make(TASK),
        "healthy, corrected": ActionFlowWrapper(gymnasium.make(TASK), "mujoco"),
        "reversed": reversed_motor(),
        "reversed, corrected": ActionFlowWrapper(reversed_motor(), "mujoco"),
    }
    for name, robot in robots.items():
        env = Monitor(robot)
        env.reset(seed=0)
        mean, spread = evaluate_policy(policy, env, n_eval_episodes=args.episodes)
        print(f"{name}: return {mean:.0f} +- {spread:.0f}")


def reversed_motor() -> gymnasium.Env:
    env = gymnasium.make(TASK)
    return TransformAction(env, np.negative, env.action_space)


if __name__ == "__main__":
    main()
