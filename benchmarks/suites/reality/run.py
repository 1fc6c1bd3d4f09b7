"""Robots that differ from their model, whose actuators fail: the return after the fault.

    python benchmarks/suites/reality/run.py

plays the episodes that are not yet in `outputs/reality` and prints the tables. All levels, faults
and draws of a robot and a method are one batch. You can interrupt it; the same command continues.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from draws import LEVELS, faults
from robots import ROBOTS, DrawnRobots, Episode, Robot

import afm_rl.correction
from afm_rl import ActionFlowVectorWrapper, FaultVectorWrapper, fit_residual
from afm_rl.dynamics import DynamicsModel, LinearResidual
from afm_rl.dynamics.linear_residual import PARTS
from afm_rl.errors import ConfigurationError
from afm_rl.method_colours import COLOURS, places_of
from afm_rl.report.statistics import resampled_bounds
from afm_rl.report.tables import interval_text, markdown
from afm_rl.storage.files import write_whole

RECORDED = 100  # healthy steps to which a residual is fitted
AFTER = 100  # steps that are played after the fault
KEYS = ["robot", "situation", "fault", "method", "seed"]


def uncorrected(robot: Robot, episodes: list[Episode]) -> None:
    """Execute the planned action."""
    return None


def nominal(robot: Robot, episodes: list[Episode]) -> DynamicsModel:
    """AFM with the nominal model."""
    return robot.model()


def exact(robot: Robot, episodes: list[Episode]) -> DynamicsModel:
    """AFM with the exact model of each drawn robot."""
    return robot.exact(episodes)


def fitted_before(robot: Robot, episodes: list[Episode]) -> DynamicsModel:
    """AFM with a residual that was fitted to 100 healthy steps of each drawn robot.

    The robot was recorded from another start, with other noise.
    """
    drawn = list(dict.fromkeys(episodes))
    envs, nominal = DrawnRobots(robot, drawn), robot.model()
    observations, _ = envs.reset(seed=1)
    steps = []
    for step in range(RECORDED):
        time = torch.full((len(drawn),), float(step))
        action = robot.act(torch.from_numpy(observations), time).clamp(robot.low, robot.high)
        before = envs.reading[:, : nominal.state_size]
        observations, *_ = envs.step(action.numpy())
        steps.append((before, action, envs.reading[:, : nominal.state_size]))
    rows = [torch.stack(part, 1) for part in zip(*steps, strict=True)]
    model = LinearResidual(nominal).expand_(len(episodes))
    for k, episode in enumerate(drawn):
        with suppress(ConfigurationError):  # nothing to improve: the nominal model stays
            fit = fit_residual(nominal, [part[k] for part in rows], guard=False)
            same = torch.tensor([other == episode for other in episodes])
            model.fitted_(same, **{name: fit.get_buffer(name) for name in PARTS})
    return model


METHODS: dict[str, Callable[[Robot, list[Episode]], DynamicsModel | None]] = {
    "without AFM": uncorrected,
    "AFM": nominal,
    "residual, fitted before": fitted_before,
    "residual, fitted online": nominal,
    "exact model": exact,
}
"""The model that a method corrects with; None: no correction."""


def play(
    robot: Robot, method: str, corrector: str, draws: int, at: int, after: int
) -> pd.DataFrame:
    """Play all levels, faults and draws side by side; return a row for each episode and measure.

    Args:
        robot: the robot.
        method: one of :data:`METHODS`.
        corrector: name of a class of :mod:`afm_rl.correction`.
        draws: of each level and fault.
        at: step at which the actuators fail.
        after: steps that are played from there.
    """
    torch.manual_seed(0)
    kinds = faults(len(robot.low))
    cases = list(product(LEVELS, kinds, range(draws)))
    episodes = [(LEVELS[level], draw) for level, _, draw in cases]
    given = [kinds[fault] for _, fault, _ in cases]
    model = METHODS[method](robot, episodes)
    home = getattr(robot.model(), "home", None)
    envs: Any = FaultVectorWrapper(DrawnRobots(robot, episodes), given, at, home)
    if model is not None:
        settings = {} if home is None else {"home": home.tolist()}
        fitted = RECORDED * (method == "residual, fitted online")
        envs = ActionFlowVectorWrapper(
            envs,
            model,
            state=lambda env, observations: env.unwrapped.reading[:, : model.state_size].numpy(),
            corrector=getattr(afm_rl.correction, corrector)(robot.low, robot.high, **settings),
            observe=lambda states: robot.observe(torch.from_numpy(states)).numpy(),
            residual_steps=fitted,
        )
    measured = run(robot, envs, at, at + after)
    heads = [(level, fault, method, draw) for level, fault, draw in cases]
    table = pd.DataFrame(heads, columns=KEYS[1:]).assign(**measured)
    return table.melt(KEYS[1:], list(measured), "measure", "value")


def run(robot: Robot, envs: Any, at: int, steps: int) -> dict[str, np.ndarray]:
    """Return the measures of all episodes, ``(N,)`` each.

    ``return`` after the fault; ``steps`` until the robot fell; ``corrected``, the share of the
    steps before the fault at which another action than the planned one was executed; ``late``, the
    share of the steps after it at which a delay of three steps was believed.
    """
    observations, infos = envs.reset()
    count = len(observations)
    total, lasted, corrected, late = np.zeros((4, count))
    alive = np.ones(count, dtype=bool)
    for step in range(steps):
        told = infos.get("afm", {"delay": np.zeros(count)})
        planned = robot.act(torch.from_numpy(observations), step + torch.from_numpy(told["delay"]))
        observations, rewards, fallen, _, infos = envs.step(planned.numpy())
        if "afm" in infos:
            told = infos["afm"]
            changed = (told["planned_action"] != told["executed_action"]).any(-1)
            corrected += changed / max(at, 1) * (step < at)
            late += (told["delay"] == 3) / (steps - at) * (step >= at)
        total += rewards * alive * (step >= at)
        lasted += alive
        alive &= ~fallen
    return {"return": total, "steps": lasted, "corrected": corrected, "late": late}


def results_of(name: str, method: str, args: argparse.Namespace) -> pd.DataFrame:
    """Return the rows of a robot and a method: from the file, or played now."""
    parts = name, method.replace(",", "").replace(" ", "_"), f"at_{args.at}", str(args.draws)
    file = args.out / f"{'.'.join(parts)}.csv"
    if not file.is_file():
        rows = play(ROBOTS[name](), method, args.corrector, args.draws, args.at, args.after)
        rows.insert(0, "robot", name)
        write_whole(file, rows.to_csv(index=False, float_format="%.6g").encode())
    return pd.read_csv(file)


def shown(rows: pd.DataFrame, measure: str, digits: int) -> pd.DataFrame:
    """Return means of a measure with 95 % intervals: a row for each fault, a column per method."""
    mine = rows[rows["measure"] == measure]
    texts: dict[tuple[str, ...], dict[str, str]] = {}
    for (robot, level, fault, method), group in mine.groupby(KEYS[:-1], sort=False):
        values = group["value"].to_numpy()
        low, high = resampled_bounds([values], lambda samples: samples[0].mean(-1))
        mean = {"x": values.mean(), "x_low": low, "x_high": high}
        texts.setdefault((robot, level, fault), {})[method] = interval_text(mean, "x", digits)
    return table_of(texts)


def table_of(texts: dict[tuple[str, ...], dict[str, str]]) -> pd.DataFrame:
    """Return texts by robot, level and fault as a table, whose first column has these three."""
    rows = {", ".join(key).replace("_", " "): row for key, row in texts.items()}
    return pd.DataFrame(rows).T.fillna("–").rename_axis("robot, model and fault").reset_index()


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the mean return as a share of that with the exact model, with 95 % intervals.

    Draws are resampled in pairs.
    """
    wide = rows[rows["measure"] == "return"].pivot_table(
        "value", [*KEYS[:3], "seed"], "method", sort=False
    )
    texts: dict[tuple[str, ...], dict[str, str]] = {}
    for key, group in wide.groupby(level=KEYS[:3], sort=False):
        for method in wide.columns.drop("exact model"):
            pairs = group[[method, "exact model"]].to_numpy()
            low, high = resampled_bounds([pairs], lambda s: s[0].mean(-1)[0] / s[0].mean(-1)[1])
            share = {"x": pairs[:, 0].mean() / pairs[:, 1].mean(), "x_low": low, "x_high": high}
            texts.setdefault(key, {})[method] = interval_text(share, "x", 2)
    return table_of(texts)


def gains(rows: pd.DataFrame) -> pd.DataFrame:
    """Return mean differences of the return to that of AFM, with 95 % intervals of pairs."""
    wide = rows[rows["measure"] == "return"].pivot_table(
        "value", [*KEYS[:3], "seed"], "method", sort=False
    )
    others = [name for name in METHODS if name.startswith("residual") and name in wide]
    texts: dict[tuple[str, ...], dict[str, str]] = {}
    for key, group in wide.groupby(level=KEYS[:3], sort=False):
        for method in others:
            more = (group[method] - group["AFM"]).to_numpy()
            low, high = resampled_bounds([more], lambda samples: samples[0].mean(-1))
            mean = {"x": more.mean(), "x_low": low, "x_high": high}
            texts.setdefault(key, {})[method] = interval_text(mean, "x", 1)
    return table_of(texts)


def draw(rows: pd.DataFrame, file: Path) -> None:
    """Draw the mean return after each fault, a panel for each robot and level."""
    wide = rows[rows["measure"] == "return"].pivot_table(
        "value", ["robot", "situation", "fault"], "method", sort=False
    )
    wide = wide[[name for name in METHODS if name in wide]]
    colours = {name: COLOURS[place] for name, place in places_of(wide.columns).items()}
    panels = list(dict.fromkeys((robot, level) for robot, level, _ in wide.index))
    figure, axes = plt.subplots(1, len(panels), figsize=(3.4 * len(panels), 3), squeeze=False)
    for axis, panel in zip(axes[0], panels, strict=True):
        wide.loc[panel].plot.bar(ax=axis, rot=40, legend=False, width=0.8, color=colours)
        axis.set(title=", ".join(panel).replace("_", " "), xlabel="", ylabel="return")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.set_layout_engine("constrained")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--draws", type=int, default=8, help="robots that are drawn per cell")
    parser.add_argument("--at", type=int, default=60, help="step at which the actuators fail")
    parser.add_argument("--after", type=int, default=AFTER, help="steps played after that")
    parser.add_argument(
        "--corrector",
        default="ActionFlow",
        help="class of afm_rl.correction (use another --out)",
    )
    parser.add_argument("--figure", type=Path, help="draw the returns to this file, .png")
    parser.add_argument("--out", type=Path, default=Path("outputs/reality"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = pd.concat([results_of(name, m, args) for name in args.robots for m in args.methods])
    when = f"fault at step {args.at}"
    print(markdown(f"return, {when}", shown(rows, "return", 1)))
    healthy = rows[rows["fault"] == "none"]
    print(markdown(f"share of healthy steps corrected, {when}", shown(healthy, "corrected", 2)))
    late = rows[rows["fault"] == "late 3"]
    print(
        markdown(f"share of steps at which 3 steps late are found, {when}", shown(late, "late", 2))
    )
    if "exact model" in args.methods:
        print(markdown(f"share of the return with the exact model, {when}", shares(rows)))
    if "AFM" in args.methods:
        print(markdown(f"return less that of AFM with the nominal model, {when}", gains(rows)))
    if args.figure:
        draw(rows, args.figure)


if __name__ == "__main__":
    main()
