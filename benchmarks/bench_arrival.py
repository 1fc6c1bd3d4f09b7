"""What it costs to make up for late commands, in ticks of a correction without delay.

    python benchmarks/bench_arrival.py

HalfCheetah behind `ActionFlowWrapper`, its motors weak, late by some steps that are known. Time of
one thread, as ratios within one run.
"""

from __future__ import annotations

import time
from statistics import median

import gymnasium
import pandas as pd
import torch

from afm_rl import ActionFlowWrapper
from afm_rl.report.tables import markdown

WEAK, STEPS, ROUNDS = 0.6, 100, 3


class Late(gymnasium.ActionWrapper):
    """Actuators that are weak, and act some steps late."""

    def __init__(self, env: gymnasium.Env, steps: int) -> None:
        super().__init__(env)
        self.waiting = [0.0 * env.action_space.low] * steps

    def action(self, action):
        self.waiting.append(WEAK * action)
        return self.waiting.pop(0)


def spent(steps: int) -> float:
    """Return the milliseconds of a step, the median of some rounds."""
    env = ActionFlowWrapper(Late(gymnasium.make("HalfCheetah-v5"), steps), "mujoco", delay=steps)
    env.action_space.seed(0)
    env.reset(seed=0)
    rounds = []
    for _ in range(ROUNDS):
        begun = time.thread_time()
        for _ in range(STEPS):
            env.step(env.action_space.sample())
        rounds.append(10 * (time.thread_time() - begun))
    return median(rounds)


def main() -> None:
    torch.set_num_threads(1)
    usual = spent(0)
    rows = [[steps, f"{spent(steps) / usual:.2f}"] for steps in (1, 2, 4, 8)]
    heads = ["steps late", "of a step without delay"]
    print(markdown("cost", pd.DataFrame(rows, columns=heads)))


if __name__ == "__main__":
    main()
