"""The Furuta pendulum with hidden motor sign, length and tip mass, from a cold start.

    python benchmarks/suites/furuta/run.py

plays the runs that are not yet in `outputs/furuta` and prints the tables. You can interrupt it; the
same command continues. `--methods`, `--parts` and `--runs` select what is played.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from agents import METHODS, Agent
from plant import PERIOD, Plant, Simulated, drawn

from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

VALIDATION = [(23, 18, 1), (23, 42, -1), (37, 18, -1), (37, 42, 1)]  # cm, g, sign
VALIDATION += [(30, 30, 1), (26, 36, -1), (34, 22, 1), (31, 44, -1)]
NEAR, LASTS = 0.15, 20  # rad; steps: up is to stay near for a second
PUSH = 0.3  # N m
PUBLISHED = "published, with a second of excitation"  # and its film, one run
TOGETHER = 8  # runs that are played side by side, and then kept


class Run(NamedTuple):
    """One pendulum: its first state, and its plants and pushes by step."""

    start: list[float]
    plants: dict[int, Plant]
    pushes: dict[int, float]
    steps: int


def hanging(generator: np.random.Generator) -> list[float]:
    angle = np.pi + generator.normal(0, 0.05)
    return [0.0, angle, 0.0, generator.normal(0, 0.05)]


def validation() -> list[Run]:
    """Eight plants, four starts each, 20 s."""
    runs = []
    for i, (length, tip, sign) in enumerate(VALIDATION):
        for seed in range(4):
            start = hanging(np.random.default_rng(100 + 37 * i + seed))
            runs.append(Run(start, {0: Plant(length / 100, tip / 1000, sign)}, {}, 400))
    return runs


def test() -> list[Run]:
    """Twelve plants that are drawn, 20 s."""
    runs = []
    for k in range(12):
        plant = drawn(np.random.default_rng(900 + k))._replace(sign=1 if k % 2 else -1)
        runs.append(Run(hanging(np.random.default_rng(k)), {0: plant}, {}, 400))
    return runs


def film() -> list[Run]:
    """40 s with two pushes, a reversal and another pendulum; eight generators, 3 the published."""
    runs = []
    for k in range(3, 11):
        generator = np.random.default_rng(k)
        start, first = hanging(generator), Plant(0.3, 0.03, 1)
        pushes = generator.choice([-PUSH, PUSH], 2).tolist()
        other = drawn(generator)
        if k == 3:
            pushes, other = [PUSH, PUSH], Plant(0.2034, 0.0427, 1)
        plants = {0: first, 280: first._replace(sign=-1), 600: other}
        runs.append(Run(start, plants, {160: pushes[0], 480: pushes[1]}, 800))
    return runs


EVENTS = {"push": 160, "reversed": 280, "second push": 480, "other pendulum": 600}
PARTS = {"A": validation, "B": test, "film": film, "time": lambda: film()[:1]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--runs", type=int, help="the first of each part (use another --out)")
    parser.add_argument("--steps", type=int, help="cut runs (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/furuta"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    tables = []
    for part in args.parts:
        for method in args.methods:
            runs = [run._replace(steps=args.steps or run.steps) for run in PARTS[part]()]
            file = args.out / f"{part}.{method}.csv"
            tables.append(complete(file, runs[: args.runs], part, method))
    for name, table in tables_of(pd.concat(tables, ignore_index=True), args.methods).items():
        print(markdown(name, table))


def complete(file: Path, runs: Sequence[Run], part: str, method: str) -> pd.DataFrame:
    """Play the runs of a part that are not yet in a file, a few at a time; return all."""
    table = pd.read_csv(file) if file.is_file() else pd.DataFrame()
    for first in range(len(table), len(runs), TOGETHER):
        rows = pd.DataFrame(play(runs[first : first + TOGETHER], METHODS[method]))
        table = pd.concat([table, rows.assign(part=part, method=method)], ignore_index=True)
        write_whole(file, table.to_csv(index=False).encode())
        print(f"{part}, {method}: {len(table)} of {len(runs)}", flush=True)
    return table


def play(runs: Sequence[Run], method: Callable[..., Agent]) -> list[dict]:
    """Play runs of one length side by side; return a row of results for each."""
    torch.manual_seed(0)
    plants = [run.plants[0] for run in runs]
    world, agent = Simulated(plants, np.array([run.start for run in runs])), method(len(runs))
    angles, spent, state = [], [], world.states
    for k in range(runs[0].steps):
        for row, run in enumerate(runs):
            if k and k in run.plants:
                plants[row] = run.plants[k]
                world.change(row, plants[row])
        agent.inform(plants)
        began = time.process_time()
        voltages = agent.act(state)
        spent.append(time.process_time() - began)
        state = world.step(voltages, [run.pushes.get(k, 0.0) for run in runs])
        began = time.process_time()
        agent.learn(state)
        spent[-1] += time.process_time() - began
        angles.append(state[:, 1].abs().numpy())
    cost = {f"ms {q}": 1e3 * np.quantile(spent, q / 100) for q in (50, 95, 100)}
    cost["ms mean"] = 1e3 * np.mean(spent)
    return [score(mine) | cost for mine in np.stack(angles, 1)]


def score(angles: np.ndarray) -> dict:
    """Return the measures of one run, from the angles ``(T,)`` off upright."""
    up = recovery(angles, 0)
    after = angles[round(up / PERIOD) :] if np.isfinite(up) else np.array([np.inf])
    measures = {"up": up, "held": (after < NEAR).mean(), "rms": np.sqrt((after**2).mean())}
    return measures | {name: recovery(angles, at) for name, at in EVENTS.items()}


def recovery(angles: np.ndarray, at: int) -> float:
    """Return seconds from step ``at`` on until the pendulum is up and stays up for a second.

    >>> recovery(np.r_[np.full(7, 3.0), np.zeros(20)], 2)
    0.25
    """
    if len(angles) < at + LASTS:
        return np.inf
    near = np.convolve(angles[at:] < NEAR, np.ones(LASTS), "valid") > LASTS - 0.5
    return float(near.argmax() * PERIOD) if near.any() else np.inf


def tables_of(rows: pd.DataFrame, methods: Sequence[str]) -> dict[str, pd.DataFrame]:
    """Return the tables of the page."""
    up, film = [], []
    for method in methods:
        a, b, events, alone = (_of(rows, method, part) for part in PARTS)
        good = np.isfinite(a["up"]) & (a["held"] > 0.95)
        cells = [method, f"{good.sum()}/{len(a)}", _middle(a["up"]), f"{a['up'].max():.2f}"]
        cells += [f"{a['rms'].max():.3f}", f"{np.isfinite(b['up']).sum()}/{len(b)}"]
        up.append([*cells, _middle(b["up"])])
        cells = [f"{_middle(events[name])}, {events[name].max():.2f}" for name in EVENTS]
        lost = np.isinf(events[[*EVENTS]]).any(axis=1).sum()
        ms = ", ".join(f"{alone[f'ms {q}'].mean():.1f}" for q in ("50", "95", "mean"))
        film.append([method, *cells, f"{lost}/{len(events)}", ms])
    up.append([PUBLISHED, "32/32", "2.1", "18.8", "0.047", "12/12", ""])
    film.append([PUBLISHED, "1.0", "3.7", "1.0", "1.2", "0/1", "50 on 12 cores"])
    heads = ["", "up, A", "median time (s)", "slowest (s)", "worst RMS (rad)", "up, B"]
    costs = ["lost", "ms a step: median, 95 %, mean"]
    tables = {"up": pd.DataFrame(up, columns=[*heads, "median (s)"])}
    tables["film"] = pd.DataFrame(film, columns=["film", *EVENTS, *costs])
    return {name: table.replace("inf", "∞", regex=True) for name, table in tables.items()}


def _of(rows: pd.DataFrame, method: str, part: str) -> pd.DataFrame:
    return rows[(rows["method"] == method) & (rows["part"] == part)]


def _middle(values: pd.Series) -> str:
    return f"{np.quantile(values, 0.5, method='higher'):.2f}" if len(values) else "–"


if __name__ == "__main__":
    main()
