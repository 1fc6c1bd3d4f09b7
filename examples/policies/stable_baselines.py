"""A policy of Stable-Baselines3 on a robot with a reversed motor, without and with AFM.

    python examples/policies/stable_baselines.py

`pip install 'afm-rl[gym,sb3]'` first. The policy is trained on the healthy inverted pendulum.
"""

from __future__ import annotations

import argparse
from functools import partial

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from afm_rl import ActionFlowVecEnv, FaultWrapper

TASK = "InvertedPendulum-v5"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30_000, help="of training")
    parser.add_argument("--episodes", type=int, default=10)
    args = parser.parse_args()
    torch.set_num_threads(1)
    policy = PPO("MlpPolicy", gymnasium.make(TASK), seed=0, device="cpu").learn(args.steps)
    for fault in ("none", "one reversed"):
        for who in ("without AFM", "with AFM"):
            env = DummyVecEnv([partial(robot, fault)])
            env = ActionFlowVecEnv(env) if who == "with AFM" else env
            env.seed(0)
            mean, spread = evaluate_policy(policy, env, n_eval_episodes=args.episodes)
            print(f"{fault}, {who}: return {mean:.0f} +- {spread:.0f}")


def robot(fault: str) -> gymnasium.Env:
    return Monitor(FaultWrapper(gymnasium.make(TASK), fault))


if __name__ == "__main__":
    main()
