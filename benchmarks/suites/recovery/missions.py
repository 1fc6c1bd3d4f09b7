"""Robots that a planner drives, by the command line of the library."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from afm_rl.regimes import presets

METHODS = {"alone": "physics", "AFM": "afm_physics", "truth": "oracle"}


class Mission(NamedTuple):
    """A robot on the command line, and what its faults are called."""

    options: list[str]
    dt: float  # s
    setting: str  # of how long a mission is
    steps: int  # its value
    faults: dict[str, str]


def _actuators(count: int) -> dict[str, str]:
    return {
        name: "{" + ", ".join(f"{part}: {value:g}" for part, value in fault.items()) + "}"
        for name, fault in presets(count).items()
    }


GROUND = {
    "one reversed": "{v_gain: -1}",
    "all reversed": "{v_gain: -1, omega_gain: -1}",
    "half": "{v_gain: .5, omega_gain: .5}",
    "bias .3": "{v_bias: .3, omega_bias: .3}",
    "late 2": "{delay: 2}",
    "swapped pair": "{v_from: 1, omega_from: 0}",
}
FLIGHT = {  # a thrust cannot be reversed, and half of it does not carry the robot
    "one reversed": "{roll_gain: -1}",
    "all reversed": "{roll_gain: -1, pitch_gain: -1, yaw_gain: -1}",
    "half": "{roll_gain: .5, pitch_gain: .5, yaw_gain: .5}",
    "late 2": "{delay: 2}",
    "swapped pair": "{roll_from: 2, pitch_from: 1}",
}
CONTROL = ["robot=dm_control", "robot.schedule.at=[0.4]"]
MISSIONS = {
    "cart-pole": Mission(
        [*CONTROL, "robot.domain=cartpole", "robot.task=balance"],
        *(0.01, "robot.steps", 500, _actuators(1)),
    ),
    "hard reacher": Mission(
        [*CONTROL, "robot.domain=reacher", "robot.task=hard", "planner.hold=2"],
        *(0.02, "robot.steps", 400, _actuators(2)),
    ),
    "ground robot": Mission(
        ["robot=ugv", "tracks=ethz_1", "planner.population=200", "robot.schedule.at=[0.3]"],
        *(0.2, "budget", 400, GROUND),
    ),
    "quadrotor": Mission(
        ["robot=quadrotor", "robot.schedule.times=[2.0]", "robot.env.start_noise=0.02"],
        *(0.05, "robot.env.duration", 8, FLIGHT),
    ),
}


def rewards(
    task: str, method: str, names: list[str], seeds: int, out: Path, steps: int | None
) -> tuple[dict[tuple[str, int], np.ndarray], float]:
    """Return the rewards after the fault by fault and seed, and seconds a step."""
    mission, name = MISSIONS[task], METHODS[method]
    faults = {"none": "{}", **{fault: mission.faults.get(fault) for fault in names}}
    played = [fault for fault, regime in faults.items() if regime]
    folder = out / "missions" / f"{task.replace(' ', '_')}.{name}"
    command = [sys.executable, "-m", "afm_rl", *mission.options, f"compare=[{name}]"]
    command += [f"regimes=[{', '.join(faults[fault] for fault in played)}]", f"seeds={seeds}"]
    command += [f"{mission.setting}={steps or mission.steps}", f"hydra.run.dir={folder}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    table = pd.read_parquet(folder / "steps.parquet")
    groups = [group for _, group in table.groupby("mission")]
    at = [int(group["regime_active"].to_numpy().argmax()) for group in groups]
    at[:seeds] = [int(np.median(at[seeds:]))] * seeds  # healthy ones show no change
    by_seed, length = {}, max(len(group) for group in groups)
    for number, (group, begin) in enumerate(zip(groups, at, strict=True)):
        mine = _rewards(group)
        # What ended early has no reward any more, or its worst error.
        rest = min(0.0, mine.min()) if "reward" not in group else 0.0
        mine = np.append(mine, np.full(max(0, length - len(group)), rest))
        by_seed[played[number // seeds], number % seeds] = mine[begin:]
    return by_seed, mission.dt


def _rewards(steps: pd.DataFrame) -> np.ndarray:
    """Return what counts at each step: reward, less error, or speed towards the goal."""
    if "reward" in steps:
        return steps["reward"].to_numpy(float)
    if "square_error_x" in steps:
        return -np.sqrt(steps[[f"square_error_{axis}" for axis in "xyz"]].sum(1).to_numpy(float))
    place, goal = steps[["x", "y"]].to_numpy(float), steps[["goal_x", "goal_y"]].to_numpy(float)
    distance = np.linalg.norm(goal - place, axis=1)[:-1]
    return distance - np.linalg.norm(goal[:-1] - place[1:], axis=1)
