"""A policy on a robot with a reversed motor, without and with AFM.

    python examples/policies/correct_a_policy.py

The wrapper is between any policy (Stable-Baselines3, CleanRL, TorchRL) and the robot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import torch

from afm_rl import ActionFlowWrapper, FaultWrapper
from afm_rl.planning import load_policy

POLICY = Path(__file__).with_name("half_cheetah_sac.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--at", type=int, default=500, help="step at which the motor is reversed")
    parser.add_argument("--model", choices=["mujoco", "learn"], default="mujoco")
    args = parser.parse_args()
    torch.set_num_threads(1)
    robot = FaultWrapper(gymnasium.make("HalfCheetah-v5"))
    corrected = ActionFlowWrapper(robot, args.model)
    info = corrected.reset(seed=1)[1]["afm"]
    while not info.get("learned", True):  # 20 healthy episodes, and a minute for the fit
        play(corrected, args.steps)
        info = corrected.reset()[1]["afm"]
    robot.fail("one reversed", args.at)  # the motor of the back thigh
    for name, env in {"without AFM": robot, "with AFM": corrected}.items():
        rewards = play(env, args.steps, seed=0)
        before, after = rewards[: args.at], rewards[args.at :]
        print(f"{name}: a step {mean(before):.2f} before, {mean(after):.2f} after")
    for line in corrected.diagnosis.splitlines():
        print(f"    {line}")


def play(env: gymnasium.Env, steps: int, seed: int | None = None) -> list[float]:
    """Return the rewards of an episode of the policy."""
    policy, _ = load_policy(POLICY)
    (observation, _), rewards = env.reset(seed=seed), []
    for _ in range(steps):
        action = policy(torch.as_tensor(observation)).numpy()
        observation, reward, *_ = env.step(action)
        rewards.append(float(reward))
    return rewards


def mean(values: list[float]) -> float:
    return sum(values) / max(len(values), 1)


if __name__ == "__main__":
    main()
