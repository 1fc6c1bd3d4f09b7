"""The runs of RealAIGym's robustness V2: their parameters, and the condition of a success."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from plant import DRIVEN, DT, GOAL, LIMIT, NOMINAL, Physics, difference, step
from torch import Tensor

from afm_rl.report.statistics import resampled_bounds, split

STEPS = 5000  # of a run
VALUES, REPEATS, PUSHED = 21, 10, 50  # of each parameter; of each run with noise; runs with pushes
COLUMNS = ["model", "velocity noise", "torque noise", "torque response", "delay", "pushes"]
NOISY = ["velocity noise", "torque noise"]
TOLERANCE = [0.35, 0.35, 1.0, 1.0]  # rad, rad, rad/s, rad/s from upright, at the end of a run
PULSES, APART = 3, 1.0  # pushes at the driven joint, and as many that meet no motor; s between two
WIDTHS, SIZES = (0.05, 0.1), (0.5, 5.0)  # s, N m

Controller = Callable[[Tensor, int], Tensor]
"""Torques ``(N,)`` for measured states ``(N, 4)`` at a step."""
Interrupt = Callable[[Tensor, Tensor, int], Tensor]
"""Torques of both joints ``(N, 2)`` in the place of others, for measured states at a step."""


class Runs(NamedTuple):
    """The parameters of each run, ``(N,)`` unless stated otherwise."""

    column: list[str]
    value: Tensor
    physics: Physics
    velocity_noise: Tensor
    """standard deviation of measured speeds, rad/s"""
    torque_noise: Tensor
    """standard deviation, N m"""
    response: Tensor
    """share of the way to a torque that is made in a step"""
    gain: Tensor
    """share of a torque that is made in the end"""
    delay: Tensor
    """steps until a state is known"""
    pushes: Tensor
    """torque at the driven joint, ``(T, N)``, N m"""


def runs_of(generator: torch.Generator, repeats: int = REPEATS) -> Runs:
    """Return all runs of a controller, side by side.

    Each run varies one parameter, the others are nominal.

    >>> runs = runs_of(torch.Generator().manual_seed(0))
    >>> pd.Series(runs.column).value_counts(sort=False).tolist()
    [210, 210, 210, 21, 21, 50]
    """

    def between(low: float, high: float) -> list[float]:
        return torch.linspace(low, high, VALUES, dtype=torch.float64).tolist()

    nominal = NOMINAL._asdict()
    around = {name: nominal[name] for name in ("r1", "I1", "r2", "m2", "I2")}
    models = {name: between(0.75 * value, 1.25 * value) for name, value in around.items()}
    models |= {"Ir": between(0.0, 1e-4), "b1": between(-0.1, 0.1), "b2": between(-0.1, 0.1)}
    models |= {"cf1": between(-0.2, 0.2), "cf2": between(-0.2, 0.2)}
    changes = [("model", name, value) for name, values in models.items() for value in values]
    for name, values in (
        ("velocity noise", between(0.0, 0.5)),
        ("torque noise", between(0.0, 1.1)),
        ("torque response", between(0.1, 2.0)),
        ("delay", range(VALUES)),
        ("pushes", range(PUSHED)),
    ):
        changes += [(name, name, v) for v in values for _ in range(repeats if name in NOISY else 1)]

    def changed(name: str, base: float) -> Tensor:
        values = [value if what == name else base for _, what, value in changes]
        return torch.tensor(values, dtype=torch.float64)

    pushes = torch.zeros(STEPS, len(changes), dtype=torch.float64)
    pushes[:, -PUSHED:] = draw_pushes(PUSHED, generator)
    return Runs(
        [column for column, _, _ in changes],
        torch.tensor([value for _, _, value in changes], dtype=torch.float64),
        Physics(*(changed(*item) for item in nominal.items())),
        *(changed(name, 0.0) for name in NOISY),
        changed("torque response", 1.0),
        changed("gain", 1.0),
        changed("delay", 0.0).long(),
        pushes,
    )


def draw_pushes(count: int, generator: torch.Generator) -> Tensor:
    r"""Return torques ``(T, count)`` at the driven joint, three pulses of Gaussian shape each.

    Six pulses fall on both joints, at least a second apart. The other joint has no motor, and the
    benchmark pushes motors, so pushes on that joint have no effect.
    """

    def draw(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator, dtype=torch.float64)

    number = 2 * PULSES
    room = (STEPS * DT - (number + 1) * APART) / number
    times = (APART + room * draw(number)).cumsum(-1)
    times = times.gather(-1, draw(number).argsort(-1)[:, :PULSES])
    width = WIDTHS[0] + (WIDTHS[1] - WIDTHS[0]) * draw(PULSES)
    size = (SIZES[1] - SIZES[0]) * (2 * draw(PULSES) - 1)
    size = size + SIZES[0] * size.sign()
    now = DT * torch.arange(STEPS, dtype=torch.float64)[:, None, None]
    return (size * (-0.5 * ((now - times) / width).square()).exp()).sum(-1)


def play(
    robot: str,
    runs: Runs,
    act: Controller,
    generator: torch.Generator,
    steps: int = STEPS,
    interrupt: Interrupt | None = None,
) -> Iterator[Tensor]:
    """Yield the states ``(N, 4)`` after each step of runs that begin hanging at rest."""
    count = len(runs.column)
    state = torch.zeros(count, 4, dtype=torch.float64)
    past = state.repeat(VALUES, 1, 1)  # of the last steps, in turns
    torque, axis = state.new_zeros(count, 2), torch.eye(2, dtype=torch.float64)[DRIVEN[robot]]
    for k in range(steps):
        past[k % VALUES] = state
        seen = past[(k - runs.delay).clamp(min=0) % VALUES, range(count)]
        noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
        speeds = seen[:, 2:] + runs.velocity_noise[:, None] * noise[:, :2]
        seen = torch.cat([seen[:, :2], speeds], -1)
        command = act(seen, k)[:, None] * axis
        if interrupt is not None:
            command = interrupt(command, seen, k)
        wanted = runs.gain[:, None] * command
        torque = torque + runs.response[:, None] * (wanted - torque)
        torque = torque + (runs.torque_noise * noise[:, 2])[:, None] * axis
        torque = torque.clamp(-LIMIT, LIMIT) + runs.pushes[k][:, None] * axis
        state = step(state, torque, runs.physics)
        yield state


def upright(state: Tensor) -> Tensor:
    """Return which states ``(*B, 4)`` count as a success.

    >>> upright(torch.tensor([[3.3, 6.3, 0.9, 0.0], [3.3, 0.0, 1.1, 0.0]]))
    tensor([ True, False])
    """
    return (difference(state, state.new_tensor(GOAL)).abs() < state.new_tensor(TOLERANCE)).all(-1)


def shares(runs: Runs, success: Tensor) -> pd.DataFrame:
    """Return the share of successes of each column, and the score, with their 95 % intervals.

    Runs with noise count once per value, by their majority. These runs and pushes are resampled for
    the intervals, which are NaN if nothing is random.

    >>> runs = runs_of(torch.Generator().manual_seed(0), repeats=1)
    >>> delayed = torch.tensor([column == "delay" for column in runs.column])
    >>> shares(runs, delayed)["share"].round(3).tolist()
    [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.167]
    """
    table = pd.DataFrame({"column": runs.column, "value": runs.value, "success": success})
    samples = {}
    for column, rows in table.groupby("column"):
        alike = rows["value"] if column in NOISY else np.arange(len(rows)) * (column != "pushes")
        samples[column] = split(rows["success"].to_numpy(float), alike)

    def share(column: str, samples: list[np.ndarray]) -> np.ndarray:
        means = np.stack([sample.mean(-1) for sample in samples])
        return (means > 0.5 if column in NOISY else means).mean(0)

    def score(together: list[np.ndarray]) -> np.ndarray:
        left = iter(together)
        return np.mean([share(c, list(islice(left, len(samples[c])))) for c in COLUMNS], 0)

    statistics = {column: partial(share, column) for column in COLUMNS}
    samples["score"] = [sample for column in COLUMNS for sample in samples[column]]
    statistics["score"] = score
    rows = {
        name: [float(statistic(samples[name])), *resampled_bounds(samples[name], statistic)]
        for name, statistic in statistics.items()
    }
    return pd.DataFrame(rows, index=["share", "low", "high"]).T
