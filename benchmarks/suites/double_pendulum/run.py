"""RealAIGym's robustness V2: swing up a double pendulum that differs from its model.

    python benchmarks/suites/double_pendulum/run.py

All runs of a robot and a controller are one batch. Results are stored in `outputs/double_pendulum`;
delete them to play again. Without `--trajectories`, TVLQR tracks a nominal run of the planner.
"""

from __future__ import annotations

import argparse
from collections import deque
from pathlib import Path

import pandas as pd
import torch
from controllers import Corrected, Receding, Tracking, differentiated, model_of
from plant import DRIVEN
from runs import COLUMNS, REPEATS, STEPS, Controller, play, runs_of, shares, upright
from torch import Tensor

from afm_rl.report import style
from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

PUBLISHED = {
    "acrobot": {
        "History SAC": [58.1, 23.8, 100.0, 100.0, 90.5, 78.0, 0.751],
        "AR-EAPO": [67.6, 28.6, 100.0, 100.0, 76.2, 64.0, 0.727],
        "evolSAC": [64.8, 23.8, 100.0, 100.0, 47.6, 76.0, 0.687],
        "TVLQR": [48.1, 19.0, 100.0, 95.2, 23.8, 78.0, 0.607],
        "iLQR-MPC": [6.7, 9.5, 90.5, 52.4, 4.8, 42.0, 0.343],
        "MC-PILCO": [9.0, 9.5, 19.0, 52.4, 4.8, 50.0, 0.241],
        "Riccati gains": [4.8, 9.5, 9.5, 52.4, 4.8, 2.0, 0.138],
    },
    "pendubot": {
        "AR-EAPO": [87.6, 81.0, 100.0, 100.0, 81.0, 98.0, 0.913],
        "evolSAC": [75.2, 57.1, 100.0, 100.0, 71.4, 68.0, 0.786],
        "History SAC": [68.1, 47.6, 100.0, 100.0, 100.0, 46.0, 0.770],
        "TVLQR": [62.9, 90.5, 100.0, 100.0, 42.9, 64.0, 0.767],
        "iLQR-MPC": [31.9, 90.5, 100.0, 100.0, 38.1, 44.0, 0.674],
        "MC-PILCO": [24.8, 76.2, 61.9, 95.2, 28.6, 82.0, 0.614],
        "Riccati gains": [5.2, 38.1, 9.5, 85.7, 14.3, 0.0, 0.255],
    },
}
DRAWN = [f"{name}, published" for name in ("History SAC", "AR-EAPO", "TVLQR")]
METHODS = ["TVLQR", "TVLQR+positions", "TVLQR+AFM", "MPC+positions", "MPC+AFM+positions"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=DRIVEN, default=list(DRIVEN))
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--trajectories", type=Path, help="folder of ROBOT/ilqr_1/trajectory.csv")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="of each run with noise")
    parser.add_argument("--steps", type=int, default=STEPS, help="cut runs (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/double_pendulum"))
    parser.add_argument("--figure", type=Path, help="draw bars of all columns into this file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    heads, scores, bars = [*COLUMNS, "score"], {}, {}
    for robot in args.robots:
        results = {name: result_of(robot, name, args) for name in args.methods}
        published = {f"{name}, published": row for name, row in PUBLISHED[robot].items()}
        rows = {name: [*row[:-1], f"{row[-1]:.3f}"] for name, row in published.items()}
        rows |= {name: cells(result) for name, result in results.items()}
        table = pd.DataFrame(rows, heads)
        print(markdown(robot, table.T.reset_index(names="controller")))
        scores[robot] = table.loc["score"]
        measured = {name: 100 * result["share"] for name, result in results.items()}
        bars[robot] = pd.DataFrame(published | measured, heads).loc[COLUMNS, [*DRAWN, *measured]]
    table = pd.DataFrame(scores).reindex(rows)
    print(markdown("score", table.reset_index(names="controller")))
    if args.figure:
        looks = style.method_styles([*DRAWN, *args.methods])
        draw(bars, {name: look.color for name, look in looks.items()}, args.figure)


def result_of(robot: str, method: str, args: argparse.Namespace) -> pd.DataFrame:
    """Return the shares of a controller and its score, with their intervals."""
    file = args.out / f"{robot}.{method}.csv"
    generator = torch.Generator().manual_seed(0)
    runs = runs_of(generator, args.repeats)
    if not file.is_file():
        act = controller_of(robot, method, len(runs.column), args.trajectories)
        (end,) = deque(play(robot, runs, act, generator, args.steps), maxlen=1)
        known = {"column": runs.column, "value": runs.value, "success": upright(end)}
        ends = dict(zip(["angle1", "angle2", "speed1", "speed2"], end.unbind(-1), strict=True))
        table = pd.DataFrame(known | ends)
        write_whole(file, table.to_csv(index=False).encode())
    return shares(runs, torch.tensor(pd.read_csv(file)["success"]))


def cells(result: pd.DataFrame) -> list[str]:
    """Write shares in % and the score, with intervals if the runs are random."""
    texts = []
    for name, row in result.iterrows():
        scale, digits = (1, 3) if name == "score" else (100, 1)
        value, low, high = scale * row
        interval = f" [{low:.{digits - 1}f}, {high:.{digits - 1}f}]" if low < high else ""
        texts.append(f"{value:.{digits}f}{interval}")
    return texts


def controller_of(robot: str, method: str, count: int, folder: Path | None) -> Controller:
    """Return a controller of so many runs."""
    base, *more = method.split("+")
    act = Receding(robot, count) if base == "MPC" else Tracking(robot, *swing_up(robot, folder))
    if "AFM" in more:
        act = Corrected(robot, act)
    return differentiated(act) if "positions" in more else act


def swing_up(robot: str, folder: Path | None) -> tuple[Tensor, Tensor]:
    """Return states and torques of a swing-up: from a file, or of a nominal run of the planner."""
    if folder is not None:
        table = pd.read_csv(folder / robot / "ilqr_1" / "trajectory.csv")
        table = torch.tensor(table.to_numpy(float)[::2])  # it has a row for each millisecond
        return table[:, 1:5], table[:, 5 + DRIVEN[robot]]
    act, model, states, torques = Receding(robot, 1), model_of(robot, 1), [], []
    state = torch.zeros(1, 4, dtype=torch.float64)
    for k in range(STEPS // 2):
        states.append(state)
        torques.append(act(state, k))
        state = model(state, torques[-1].unsqueeze(-1))
    return torch.cat(states), torch.cat(torques)


def draw(bars: dict[str, pd.DataFrame], colours: dict[str, str], file: Path) -> None:
    """Draw the shares: a panel for each robot, a group of bars for each column."""
    figure = style.new_figure(9.0, 2.6 * len(bars))
    panels = figure.subplots(len(bars), 1, sharex=True, squeeze=False).flatten()
    for panel, (robot, table) in zip(panels, bars.items(), strict=True):
        table.plot.bar(ax=panel, rot=0, width=0.8, title=robot, color=colours, legend=False)
        style.dress(panel, y="successes (%)")
    style.legend_above(figure, *panels[0].get_legend_handles_labels())
    write_whole(file, style.png_bytes(figure))


if __name__ == "__main__":
    main()
