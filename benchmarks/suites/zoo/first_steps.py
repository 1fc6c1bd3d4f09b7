"""Episodes of a robot that is late from the first step on, one after the other.

    python benchmarks/suites/zoo/first_steps.py --policy walker2d_tqc --delays 5 9 13

The memory of the correction is kept from one episode to the next. A cell is the return of an
episode, and after how many steps the robot fell, if it did.
"""

from __future__ import annotations

import argparse

import pandas as pd
import torch
from methods import method_of
from task import POLICIES, Task

from afm_rl import ActionFlowVectorWrapper, FaultVectorWrapper
from afm_rl.report.tables import markdown

METHODS = ("AFM, up to 25 steps", "AFM, soft start")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="walker2d_tqc")
    parser.add_argument("--delays", type=int, nargs="*", default=[5, 9, 13])
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--steps", type=int, default=150, help="of an episode, at most")
    args = parser.parse_args()
    torch.set_num_threads(1)
    task = Task(POLICIES / f"{args.policy}.safetensors")
    rows = []
    for delay in args.delays:
        for method in METHODS:
            played = episodes(task, method, delay, args.episodes, args.steps)
            rows.append([f"late {delay}, {method}", *played])
            print(*rows[-1], sep=" | ", flush=True)
    columns = ["case", *(f"episode {k + 1}" for k in range(args.episodes))]
    print(markdown("episodes", pd.DataFrame(rows, columns=columns)))


def episodes(task: Task, method: str, delay: int, count: int, steps: int) -> list[str]:
    """Play episodes of seeds 0, 1, ... with one memory; return a cell for each."""
    robot, corrector = method_of(method, task, f"late {delay}")
    late = FaultVectorWrapper(robot.vector(1), {"delay": delay})
    envs = ActionFlowVectorWrapper(
        late, corrector=corrector, keep_memory_on_reset=True, **robot.vector_settings
    )
    cells = []
    for seed in range(count):
        act, (observations, infos) = task.begin([seed]), envs.reset(seed=[seed])
        total, lasted, over = 0.0, 0, False
        while lasted < steps and not over:
            action = act(observations, infos)
            observations, reward, terminated, truncated, infos = envs.step(action)
            total, lasted, over = total + reward.item(), lasted + 1, terminated.item()
        cells.append(f"{total:.0f}" + f" ({lasted} steps)" * over)
    envs.close()
    return cells


if __name__ == "__main__":
    main()
