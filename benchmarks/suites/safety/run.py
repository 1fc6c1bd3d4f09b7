"""Is a correction ever worse than none? Situations that are no fault of the actuators.

    python benchmarks/suites/safety/run.py

plays the policy alone and corrected in every situation, and prints the table of
docs/reliability.md. Each robot's costs are kept in `outputs/safety`; delete them to play again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
import torch
from batches import flow_for
from batches import play as play_world
from tasks import CHANGES, ROBOTS
from tasks import play as play_task
from worlds import SITUATIONS, ground, pendulum

from afm_rl.storage.files import write_whole

WORLDS = {"pendulum": pendulum, "ground robot": ground}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", default=[*WORLDS, *ROBOTS])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("outputs/safety"))
    parser.add_argument(
        "--set", nargs="*", default=[], help="of the correction, such as odds=0; with another --out"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings = {name: float(value) for name, value in (pair.split("=") for pair in args.set)}
    if settings and not set(args.robots) <= set(WORLDS):
        parser.error(f"--set: only with --robots of {', '.join(WORLDS)}")
    tables = [costs(name, args.seeds, args.out, settings) for name in args.robots]
    print_table(pd.concat(tables, ignore_index=True), args.seeds)


def costs(name: str, seeds: int, out: Path, settings: dict[str, float]) -> pd.DataFrame:
    """Return the costs of a robot, a row for each situation and seed; from the file if it is."""
    file = out / f"{name.replace(' ', '_')}.{seeds}.csv"
    if file.is_file():
        return pd.read_csv(file)
    if name in WORLDS:
        world, names = WORLDS[name](), list(SITUATIONS)
        rules = list(SITUATIONS.values())
        alone = play_world(world, rules, seeds, None).numpy()
        corrected = play_world(world, rules, seeds, flow_for(world, **settings)).numpy()
    else:
        names = list(CHANGES)
        alone, corrected = (play_task(name, afm, seeds) for afm in (False, True))
    rows = [
        {"robot": name, "situation": names[i], "seed": k, "alone": alone[i, k], "AFM": value}
        for i, row in enumerate(corrected)
        for k, value in enumerate(row)
    ]
    table = pd.DataFrame(rows)
    write_whole(file, table.to_csv(index=False).encode())
    return table


def judge(rows: pd.DataFrame) -> pd.Series:
    """Return mean costs, and whether they differ by two standard errors and 2 %."""
    change = rows["AFM"] - rows["alone"]
    error = change.std() / len(change) ** 0.5
    alone = rows["alone"].mean()
    apart = abs(change.mean()) > max(2 * error, 0.02 * abs(alone), 1e-3)
    verdict = ("worse" if change.mean() > 0 else "better") if apart else ""
    return pd.Series({"alone": alone, "AFM": rows["AFM"].mean(), "": verdict})


def print_table(table: pd.DataFrame, seeds: int) -> None:
    """Print the mean cost a step of every situation, and how many are worse."""
    grouped = table.groupby(["robot", "situation"], sort=False)
    shown = grouped[["alone", "AFM"]].apply(judge).reset_index()
    print("| robot | situation | alone | AFM | |\n|---|---|---|---|---|")
    for row in shown.itertuples(index=False):
        print(f"| {row[0]} | {row[1]} | {row[2]:.3f} | {row[3]:.3f} | {row[4]} |")
    count = shown[""].value_counts()
    print(
        f"\n{len(shown)} situations, {seeds} seeds: "
        f"worse {count.get('worse', 0)}, better {count.get('better', 0)}"
    )


if __name__ == "__main__":
    main()
