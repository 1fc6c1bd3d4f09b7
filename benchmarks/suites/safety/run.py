"""Situations in which a correction may be worse than none, most without a fault of the actuators.

    python benchmarks/suites/safety/run.py

plays the policy without and with AFM in every situation, and prints the costs. The costs of each
robot are stored in `outputs/safety`; delete them to play again. The policies in MuJoCo take hours:
`--robots half_cheetah_tqc hopper_trpo swimmer_trpo`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
import torch
from batches import play as play_world
from omegaconf import OmegaConf
from tasks import CHANGES, ROBOTS
from tasks import play as play_task
from worlds import ACTUATED, ACTUATORS, PLANS, SITUATIONS, WORLDS

from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

HEADS, COSTS = ["robot", "situation", "seed"], ["healthy", "without AFM", "AFM"]
SEEDS = {"30 servos": 3}  # each plays thirty joints; of the other robots 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--robots", nargs="*", choices=[*WORLDS, *ACTUATED, *ROBOTS], default=[*WORLDS]
    )
    parser.add_argument("--seeds", type=int, help="of every situation, at least 2")
    parser.add_argument("--out", type=Path, default=Path("outputs/safety"))
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        help="of the correction, such as saturation=clip; with another --out",
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings = dict(OmegaConf.from_dotlist(args.set))
    if settings and not set(args.robots) <= {*WORLDS, *ACTUATED}:
        parser.error(f"--set: only with --robots of {', '.join([*WORLDS, *ACTUATED])}")
    tables = [
        costs(name, args.seeds or SEEDS.get(name, 8), args.out, settings) for name in args.robots
    ]
    shown = judged(pd.concat(tables, ignore_index=True))
    costs_shown = shown.drop(columns="seeds").round(dict.fromkeys(COSTS, 3))
    print(markdown("mean cost a step", costs_shown), markdown("verdicts", summary(shown)), sep="\n")
    actuated = shown[shown["robot"].isin(ACTUATED)]
    if len(actuated):
        print(markdown("worst ratios", worst(actuated)))


def costs(name: str, seeds: int, out: Path, settings: dict) -> pd.DataFrame:
    """Return the costs of a robot, a row for each situation and seed; from the file if it is."""
    file = out / f"{name.replace(' ', '_')}.{seeds}.csv"
    if file.is_file():
        return pd.read_csv(file)
    if name not in ROBOTS:
        worlds, situations = (WORLDS, SITUATIONS) if name in WORLDS else (ACTUATED, ACTUATORS)
        world, names, rules = worlds[name](), list(situations), list(situations.values())
        plans = [{key: each[key] for key in PLANS if key in each} for each in rules]
        drives = ((plans, None), (rules, None), (rules, settings))
        results = [play_world(world, each, seeds, how).double().numpy() for each, how in drives]
    else:
        names = list(CHANGES)
        without, corrected = (play_task(name, afm, seeds) for afm in (False, True))
        results = [without, without, corrected]
    index = pd.MultiIndex.from_product([[name], names, range(seeds)], names=HEADS)
    columns = dict(zip(COSTS, (costs.flatten() for costs in results), strict=True))
    table = pd.DataFrame(columns, index).reset_index()
    write_whole(file, table.to_csv(index=False).encode())
    return table


def judge(rows: pd.DataFrame) -> pd.Series:
    """Return mean costs, and whether they differ by two standard errors and 2 %.

    Better is less than without AFM; worse is more than without AFM and than the same plans on a
    healthy robot.
    """
    mean, verdict = rows[COSTS].mean(), ""
    for word, side, before in (("better", -1, COSTS[1:2]), ("worse", 1, COSTS[:2])):
        change = side * (rows["AFM"] - rows[mean[before].idxmax()])
        error = change.std() / len(change) ** 0.5
        if change.mean() > max(2 * error, 0.02 * abs(mean[before].max()), 1e-3):
            verdict = word
    return pd.Series({**mean, "": verdict, "seeds": len(rows)})


def judged(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each robot and situation: mean costs, and the verdict."""
    grouped = table.groupby(["robot", "situation"], sort=False)
    return grouped[COSTS].apply(judge).reset_index()


def summary(shown: pd.DataFrame) -> pd.DataFrame:
    """Return how many situations of every robot are better, and which are worse."""
    rows = []
    for robot, mine in shown.groupby("robot", sort=False):
        worse_rows = mine.loc[mine[""] == "worse", ["situation", *COSTS[1:]]]
        worse = [
            f"{situation} ({without:.3f} → {corrected:.3f})"
            for situation, without, corrected in worse_rows.itertuples(index=False)
        ]
        better = (mine[""] == "better").sum()
        rows.append([robot, mine["seeds"].iloc[0], len(mine), better, len(worse), ", ".join(worse)])
    rows.append(["all", "", *(sum(row[k] for row in rows) for k in (2, 3, 4)), ""])
    heads = ["robot", "seeds", "situations", "better", "worse", "cost a step, without AFM → AFM"]
    return pd.DataFrame(rows, columns=heads)


def worst(shown: pd.DataFrame) -> pd.DataFrame:
    """Return the largest ratio of the cost with AFM to the other costs, by kind of situation."""
    kind, before = shown["situation"].str.split(":").str[0], shown[COSTS[:2]].max(axis=1)
    ratio = shown["AFM"] / before
    table = shown.assign(kind=kind, ratio=ratio)
    pivot = table.pivot_table("ratio", "kind", "robot", "max", sort=False)
    return pivot.rename_axis(columns=None).round(2).reset_index()


if __name__ == "__main__":
    main()
