"""The arena: corrections under the same faults, with the same seeds, on robots of gymnasium.

    python benchmarks/suites/zoo/arena.py
    python benchmarks/suites/zoo/arena.py --corrector mine.py:Mine

`docs/arena.md` defines the protocol. With `--corrector FILE:CLASS` your own subclass of
`afm_rl.correction.Corrector` takes part, beside no correction and AFM; it is made with the lowest
and the highest action of each robot.
"""

from __future__ import annotations

import argparse
import runpy
from typing import Any

import pandas as pd
import torch
from task import POLICIES, Task

from afm_rl import compare
from afm_rl.correction import L1Augmentation, LeastSquares
from afm_rl.report.statistics import estimate
from afm_rl.report.tables import interval_text, markdown

ROBOTS = {
    "HalfCheetah": "half_cheetah_tqc",
    "Hopper": "hopper_trpo",
    "Walker2d": "walker2d_tqc",
    "Swimmer": "swimmer_trpo",
    "Pendulum": "pendulum_sac",
}
EPISODES, STEPS, AT = 3, 200, 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=ROBOTS, default=[*ROBOTS])
    parser.add_argument("--corrector", metavar="FILE:CLASS", help="of your own")
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--steps", type=int, default=STEPS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    parts = []
    for name in args.robots:
        task = Task(POLICIES / f"{ROBOTS[name]}.safetensors")
        methods, settings = methods_of(task, args.corrector), task.robot.settings
        durations = {"episodes": args.episodes, "steps": args.steps, "at": AT}
        act = task.begin([])
        found = compare(
            task.robot.make,
            lambda seen, act=act: act(seen[None], {})[0],
            methods=methods,
            progress=False,
            **durations,
            **settings,
        )
        parts.append(found.episodes.assign(robot=name))
        print(markdown(name, table_of(parts[-1])))
    episodes = pd.concat(parts)
    print(markdown("all robots", table_of(episodes)))
    print(markdown("draws", draws_of(episodes)))


def methods_of(task: Task, own: str | None) -> dict[str, Any]:
    """Return the methods of the arena, or those that your corrector is compared with."""
    space: Any = task.robot.first.action_space
    low, high = (torch.from_numpy(end).double() for end in (space.low, space.high))
    if own is not None:
        file, _, name = own.rpartition(":")
        return {"none": "none", "AFM": "AFM", name: runpy.run_path(file)[name](low, high)}
    return {
        "none": "none",
        "least squares": "least squares",
        "L1": L1Augmentation(low, high, task.robot.dt),
        "affine": LeastSquares(low, high, form="affine"),
        "AFM": "AFM",
        "oracle": "oracle",
    }


def table_of(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the share of the healthy return by fault and method, with intervals."""

    def text(rows: pd.DataFrame) -> str:
        return interval_text(estimate("share", rows["share"], rows["robot"]), "share", 2)

    groups = episodes.groupby(["fault", "method"], sort=False)[["share", "robot"]]
    wide = groups.apply(text).unstack(sort=False)
    return wide.set_axis(list(wide), axis=1).reset_index()


def draws_of(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the returns after the fault, those of all seeds in a cell."""
    keys = ["robot", "fault", "method"]
    returns = episodes.groupby(keys, sort=False)["after"]
    listed = returns.apply(lambda rows: ", ".join(f"{value:.1f}" for value in rows))
    return listed.rename("returns of seeds 0, 1, ...").reset_index()


if __name__ == "__main__":
    main()
