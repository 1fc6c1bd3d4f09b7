"""RealAIGym's robustness V2: swing up a double pendulum that is not as it was said to be.

    python benchmarks/suites/double_pendulum/run.py

All runs of a robot and a controller are one batch. What was played is in `outputs/double_pendulum`;
delete it to play again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
import torch
from controllers import Corrected, Receding, Tracking, differentiated
from plant import DRIVEN, Physics
from runs import COLUMNS, REPEATS, STEPS, Controller, play, runs_of, shares, upright
from torch import Tensor

from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

PUBLISHED = {
    "acrobot": {
        "History SAC": [58.1, 23.8, 100.0, 100.0, 90.5, 78.0, 0.751],
        "AR-EAPO": [67.6, 28.6, 100.0, 100.0, 76.2, 64.0, 0.727],
        "TVLQR": [48.1, 19.0, 100.0, 95.2, 23.8, 78.0, 0.607],
    },
    "pendubot": {
        "AR-EAPO": [87.6, 81.0, 100.0, 100.0, 81.0, 98.0, 0.913],
        "TVLQR": [62.9, 90.5, 100.0, 100.0, 42.9, 64.0, 0.767],
    },
}
METHODS = ["TVLQR", "TVLQR, AFM", "MPC", "MPC, AFM", "MPC, positions", "MPC, AFM, positions"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=DRIVEN, default=list(DRIVEN))
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--trajectories", type=Path, help="folder of ROBOT.csv, for TVLQR")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="of each run with noise")
    parser.add_argument("--steps", type=int, default=STEPS, help="cut runs (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/double_pendulum"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    for robot in args.robots:
        rows = {f"{name}, published": row for name, row in PUBLISHED[robot].items()}
        rows |= {name: row_of(robot, name, args) for name in args.methods}
        table = pd.DataFrame(rows, index=[*COLUMNS, "score"]).T.reset_index(names="controller")
        print(markdown(robot, table))


def row_of(robot: str, method: str, args: argparse.Namespace) -> list:
    """Return the shares (%) of a controller, and its score."""
    file = args.out / f"{robot}.{method.replace(', ', '_')}.csv"
    generator = torch.Generator().manual_seed(0)
    runs = runs_of(generator, args.repeats)
    if not file.is_file():
        act = controller_of(robot, method, len(runs.column), args.trajectories)
        end = play(robot, runs, act, generator, args.steps)
        table = pd.DataFrame({"column": runs.column, "value": runs.value, "success": upright(end)})
        write_whole(file, table.to_csv(index=False).encode())
    success = torch.tensor(pd.read_csv(file)["success"])
    share = shares(runs, success)
    return [*(100 * share).round(1), round(share.mean(), 3)]


def controller_of(robot: str, method: str, count: int, folder: Path | None) -> Controller:
    """Return a controller of so many runs."""
    base, *more = method.split(", ")
    act = Receding(robot, count) if base == "MPC" else Tracking(robot, *swing_up(robot, folder))
    if "AFM" in more:
        act = Corrected(robot, act, 10 if base == "MPC" else 5)
    return differentiated(act) if "positions" in more else act


def swing_up(robot: str, folder: Path | None) -> tuple[Tensor, Tensor]:
    """Return states and torques of a swing-up: from a file, or of a nominal run of the planner."""
    if folder is not None:
        table = torch.from_numpy(pd.read_csv(folder / f"{robot}.csv").to_numpy(float))
        table = table[::2]  # a row for each millisecond
        return table[:, 1:5], table[:, 5 + DRIVEN[robot]]
    act, states, torques = Receding(robot, 1), [], []

    def noted(state: Tensor, step: int) -> Tensor:
        states.append(state)
        torques.append(act(state, step))
        return torques[-1]

    nominal = runs_of(torch.Generator(), 1).select([0])
    play(robot, nominal, noted, torch.Generator(), 3000)
    return torch.cat(states), torch.cat(torques)


if __name__ == "__main__":
    main()
