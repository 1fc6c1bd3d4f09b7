"""Is a correction ever worse than none? Situations that are no fault of the actuators.

    python benchmarks/suites/safety/run.py --write docs/reliability.md

plays the policy alone and corrected in every situation, prints the costs, and writes the table of a
page. Each robot's costs are kept in `outputs/safety`; delete them to play again. The policies in
MuJoCo take hours: `--robots half_cheetah_tqc hopper_trpo swimmer_trpo`.
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
from worlds import SITUATIONS, WORLDS

from afm_rl.storage.files import write_whole

SEEDS = {"30 servos": 3}  # each plays thirty joints; of the other robots 8
MARKS = "<!-- safety begin -->\n", "<!-- safety end -->\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=[*WORLDS, *ROBOTS], default=[*WORLDS])
    parser.add_argument("--seeds", type=int, help="of every situation, at least 2")
    parser.add_argument("--out", type=Path, default=Path("outputs/safety"))
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        help="of the correction, such as saturation=clip; with another --out",
    )
    parser.add_argument("--write", type=Path, help="page whose table is written")
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings = dict(OmegaConf.from_dotlist(args.set))
    if settings and not set(args.robots) <= set(WORLDS):
        parser.error(f"--set: only with --robots of {', '.join(WORLDS)}")
    tables = [
        costs(name, args.seeds or SEEDS.get(name, 8), args.out, settings) for name in args.robots
    ]
    shown = judged(pd.concat(tables, ignore_index=True))
    print(every(shown), summary(shown), sep="\n")
    if args.write:
        before, _, rest = args.write.read_text(encoding="utf-8").partition(MARKS[0])
        _, end, after = rest.partition(MARKS[1])
        if not end:
            raise SystemExit(f"{args.write} has no lines {' and '.join(MARKS)}".replace("\n", ""))
        new = before + MARKS[0] + summary(shown) + MARKS[1] + after
        write_whole(args.write, new.encode())


def costs(name: str, seeds: int, out: Path, settings: dict) -> pd.DataFrame:
    """Return the costs of a robot, a row for each situation and seed; from the file if it is."""
    file = out / f"{name.replace(' ', '_')}.{seeds}.csv"
    if file.is_file():
        return pd.read_csv(file)
    if name in WORLDS:
        world, names = WORLDS[name](), list(SITUATIONS)
        rules = list(SITUATIONS.values())
        alone, corrected = (
            play_world(world, rules, seeds, how).numpy() for how in (None, settings)
        )
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
    return pd.Series({"alone": alone, "AFM": rows["AFM"].mean(), "": verdict, "seeds": len(rows)})


def judged(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each robot and situation: mean costs, and the verdict."""
    grouped = table.groupby(["robot", "situation"], sort=False)
    return grouped[["alone", "AFM"]].apply(judge).reset_index()


def every(shown: pd.DataFrame) -> str:
    """Return the mean cost a step of every situation."""
    text = "| robot | situation | alone | AFM | |\n|---|---|---|---|---|\n"
    for robot, situation, alone, corrected, verdict, _ in shown.itertuples(index=False):
        text += f"| {robot} | {situation} | {alone:.3f} | {corrected:.3f} | {verdict} |\n"
    return text


def summary(shown: pd.DataFrame) -> str:
    """Return how many situations of every robot are better, and which are worse."""
    verdicts = shown[""].value_counts()
    text = f"Of {len(shown)} situations {verdicts.get('worse', 0)} are worse, "
    text += f"{verdicts.get('better', 0)} better:\n\n"
    text += "| robot | seeds | situations | better | worse: cost a step, alone → AFM |\n"
    text += "|---|---|---|---|---|\n"
    for robot, rows in shown.groupby("robot", sort=False):
        worse = [
            f"{row.situation} ({row.alone:.3f} → {row.AFM:.3f})"
            for row in rows[rows[""] == "worse"].itertuples()
        ]
        better = (rows[""] == "better").sum()
        cells = [robot, rows["seeds"].iloc[0], len(rows), better, ", ".join(worse)]
        text += f"| {' | '.join(map(str, cells))} |\n"
    return text


if __name__ == "__main__":
    main()
