"""Planner, learned model, online learner and AFM on gymnasium's own tasks.

    python examples/gymnasium_tasks/run.py --task pendulum --seeds 5

Each seed learns a model and a flow from scratch, then every method drives the same episodes,
whose actuators change half-way. A file per seed goes to `--out`; seeds that are there are not
run again: give other settings another folder. The table of all seeds is printed at the end.
"""

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from agents import METHODS, compose, learn
from tasks import TASKS, Task
from tensordict import TensorDictBase

from afm_rl.files import write_whole
from afm_rl.report.statistics import stratified_interval

SOON = 20  # steps that count as "at" the change
SPANS = ("before", "at", "after")


def spans(data: TensorDictBase, steps: int) -> dict[str, torch.Tensor]:
    """Return mean rewards ``(B,)`` per step; after the end of an episode they are zero."""
    done = data["next", "done"].squeeze(-1).int()
    running = done.cumsum(1) - done == 0
    reward = torch.where(running, data["next", "reward"].squeeze(-1), 0.0)
    half, quarter = steps // 2, steps // 4
    windows = slice(quarter, half), slice(half, half + SOON), slice(half + quarter, steps)
    return {name: reward[:, at].mean(1) for name, at in zip(SPANS, windows, strict=True)}


def measure(task: Task, seed: int, lr: float) -> pd.DataFrame:
    """Return one row per method and change."""
    learned, tables = learn(task, seed), []
    for method in METHODS:
        data = compose(task, method, learned, seed, lr).run(task.steps, seed)
        found = {name: value.tolist() for name, value in spans(data, task.steps).items()}
        tables.append(pd.DataFrame({"change": list(task.changes), "method": method, **found}))
    return pd.concat(tables).assign(seed=seed)


def table(frame: pd.DataFrame) -> str:
    """Return means over seeds with 95 % bootstrap intervals, as Markdown."""
    lines = ["| change | method | " + " | ".join(SPANS) + " |", "|---|---|" + "---|" * len(SPANS)]
    for (change, method), rows in frame.groupby(["change", "method"], sort=False):
        cells = []
        for name in SPANS:
            low, high = stratified_interval(rows[name], rows["change"])
            spread = "" if low != low else f" [{low:.2f}, {high:.2f}]"
            cells.append(f"{rows[name].mean():.2f}{spread}")
        lines.append(f"| {change} | {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", choices=TASKS, default="pendulum")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--lr", type=float, default=1e-3, help="of the online learner")
    parser.add_argument("--out", type=Path, default=Path("outputs/gymnasium"), help="folder")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    frames = []
    for seed in range(chosen.seeds):
        path = chosen.out / f"{chosen.task}_{seed}.csv"
        if not path.exists():
            frame = measure(TASKS[chosen.task], seed, chosen.lr)
            write_whole(path, frame.to_csv(index=False).encode())
        frames.append(pd.read_csv(io.BytesIO(path.read_bytes())))
    print(table(pd.concat(frames)))


if __name__ == "__main__":
    main()
