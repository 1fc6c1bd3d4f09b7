"""RealAIGym's simulation board of ICRA 2025: swing up again after each of fifteen interruptions.

    python benchmarks/suites/double_pendulum/board.py

All runs of a robot are one batch: plants, seeds, without and with AFM. What was played is in
`outputs/double_pendulum`; delete it to play again. The table has the board's seed, and the mean of
other seeds with the lowest and the highest.
"""

from __future__ import annotations

import argparse
import math
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from controllers import Corrected, Receding
from plant import DRIVEN, DT, LIMIT, NOMINAL, Physics, difference, height, weights
from runs import Runs, play
from torch import Tensor

from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

DURATION, INTERRUPTIONS, PAUSE = 60.0, 15, 0.2  # s, number, s
STEPS = round(DURATION / DT)
LINE = 0.45  # m, above which the end of the second link is up
SEEDS = {"acrobot": 777, "pendubot": 333}  # of the board
KP, KI, KD, PERIOD = 10.0, 0.1, 1.0, 0.001  # N m/rad, N m/(rad s), N m s/rad, s
FRICTION = {"b1": 0.001, "b2": 0.001, "cf1": 0.16, "cf2": 0.12, "Ir": 6.287203962819607e-05}
MOTOR = {"gain": 0.96, "delay": 2, "response": 1 - math.exp(-DT / 0.0046), "torque_noise": 0.18}
PLANTS = {"as published": {}, "friction, 8 ms late": FRICTION | {"delay": 4}, "real motor": MOTOR}
METHODS = ["MPC", "MPC+AFM"]
FAR = [0.5, 0.5, 5.0, 5.0]  # rad, rad, rad/s, rad/s
SETTINGS = {
    "acrobot": {},
    "pendubot": {"weights": [10.0, 10.0, 0.1, 0.1], "price": 1.0},
}
PUBLISHED = {  # acrobot, pendubot
    "AR-EAPO": (0.658, 0.759),
    "VIMPPI": (0.648, 0.799),
    "acados MPC": (0.630, 0.726),
    "MC-PILCO": (0.307, 0.509),
    "PRX": (0.117, 0.240),
}


class Replanning(Receding):
    """A controller that plans again where a run is not where its plan expected it.

    The new plan begins with a free motion from there.
    """

    def __call__(self, state: Tensor, step: int, late: Tensor | int = 0) -> Tensor:
        """Return the torques ``(N,)`` for these states."""
        if step % self.period == 0:
            planned = self.td["mpc", "states"]
            far = ~(difference(state, planned[:, 1]).abs() < state.new_tensor(FAR)).all(-1)
            if bool(far.any()):
                # The planner moves on by a stage before it plans.
                path = [state[far], state[far]]
                for _ in range(self.planner.horizon - 1):
                    path.append(self.planner.env.dynamics(path[-1], 0 * path[-1][:, :1]))
                planned[far] = torch.stack(path, 1).to(planned)
                self.td["mpc", "actions"][far] = 0
        return super().__call__(state, step, late)


class Interruptions:
    """The controller is off for .2 s while a PID drives both joints towards random angles.

    As in the benchmark, its angles are not wrapped, its sums run on from one interruption to the
    next, gravity is compensated, and its derivative assumes half the period that it has. It acts
    from the first step on, instead of from the third.

    Args:
        seeds: of numpy, one for each run.
        act: the controller, which learns nothing from interruptions.
    """

    def __init__(self, seeds: list[int], act: Corrected) -> None:
        goals, starts = [], []
        apart = DURATION / (INTERRUPTIONS + 1)
        even = np.linspace(apart, DURATION - apart, INTERRUPTIONS)
        for seed in seeds:
            random = np.random.RandomState(seed)
            draws = random.uniform(0.0, 2 * np.pi, (10 * INTERRUPTIONS + 1, 4))
            goals.append(draws[:INTERRUPTIONS, :2] - np.pi)
            starts.append(even + 2 * (random.rand(INTERRUPTIONS) - 0.5))
        self.goals = torch.tensor(np.stack(goals))
        self.starts = torch.tensor(np.ceil(np.stack(starts) / DT)).long()
        self.act = act
        self.total = self.error = torch.zeros(len(seeds), 2, dtype=torch.float64)

    def __call__(self, command: Tensor, state: Tensor, step: int) -> Tensor:
        """Return the torques of both joints ``(N, 2)``: those of the PID where it acts."""
        since = step - self.starts
        during = (since >= 0) & (since < round(PAUSE / DT))
        off = during.any(-1)
        if not bool(off.any()):
            return command
        self.act.restart(off)
        error = self.goals[torch.arange(len(off)), during.int().argmax(-1)] - state[:, :2]
        total = self.total + error
        torque = KP * error + KI * PERIOD * total + KD * (error - self.error) / PERIOD
        off = off.unsqueeze(-1)
        self.total, self.error = total.where(off, self.total), error.where(off, self.error)
        return (torque.clamp(-LIMIT, LIMIT) + weights(state)).where(off, command)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=DRIVEN, default=list(DRIVEN))
    parser.add_argument("--seeds", type=int, default=10, help="beside that of the board")
    parser.add_argument("--steps", type=int, default=STEPS, help="cut runs (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/double_pendulum"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    columns = {}
    for robot in args.robots:
        file, board = args.out / f"board.{robot}.csv", list(DRIVEN).index(robot)
        if not file.is_file():
            seeds = [SEEDS[robot], *range(args.seeds)]
            write_whole(file, uptimes(robot, seeds, args.steps).to_csv().encode())
        table = pd.read_csv(file, dtype={"seed": str})
        rows = {f"{name}, published": [f"{row[board]:.3f}", "–"] for name, row in PUBLISHED.items()}
        for (plant, method), runs in table.groupby(["plant", "method"], sort=False):
            first, more = runs["up"].iloc[0], runs["up"].iloc[1:]
            spread = f"{more.mean():.3f} [{more.min():.2f}, {more.max():.2f}]"
            rows[f"{method}, {plant}"] = [f"{first:.3f}", spread]
        heads = [f"{robot}, seed {SEEDS[robot]}", f"{robot}, {args.seeds} other seeds"]
        columns |= pd.DataFrame(rows, heads).T.to_dict()
    print(markdown("board", pd.DataFrame(columns).reset_index(names="controller, plant")))


def uptimes(robot: str, seeds: list[int], steps: int) -> pd.DataFrame:
    """Return which share of the time each run is up."""
    table = pd.DataFrame(list(product(PLANTS, METHODS, seeds)), columns=["plant", "method", "seed"])
    runs = runs_of(table)
    enabled = torch.tensor(table["method"].eq("MPC+AFM").to_numpy())
    act = Corrected(robot, Replanning(robot, len(table), **SETTINGS[robot]), enabled)
    interrupt = Interruptions(table["seed"].tolist(), act)
    states = play(robot, runs, act, torch.Generator().manual_seed(0), steps, interrupt)
    return table.assign(up=sum((height(state) > LINE).double() for state in states) / steps)


def runs_of(table: pd.DataFrame) -> Runs:
    """Return runs, side by side, each with the plant of a row."""

    def part(name: str, base: float) -> Tensor:
        values = [PLANTS[plant].get(name, base) for plant in table["plant"]]
        return torch.tensor(values, dtype=torch.float64)

    return Runs(
        column=table["plant"].tolist(),
        value=torch.tensor(table["seed"].to_numpy()),
        physics=Physics(*(part(*item) for item in NOMINAL._asdict().items())),
        velocity_noise=part("velocity_noise", 0.0),
        torque_noise=part("torque_noise", 0.0),
        response=part("response", 1.0),
        gain=part("gain", 1.0),
        delay=part("delay", 0.0).long(),
        pushes=part("push", 0.0).expand(STEPS, -1),
    )


if __name__ == "__main__":
    main()
