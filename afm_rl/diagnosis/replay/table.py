"""What plain methods would predict of each row of a log, and how far predictions were off."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from afm_rl.diagnosis.lines import best_line, with_one
from afm_rl.diagnosis.log import Log

Predictor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
AFM, ALONE = "AFM", "as commanded"
SHARES = {"median": 0.5, "p90": 0.9}


def as_commanded(command: np.ndarray, response: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return the command itself: nothing is corrected.

    >>> as_commanded(np.ones((2, 1)), np.zeros((2, 1)), np.zeros(2, bool)).tolist()
    [[1.0], [1.0]]
    """
    return command.copy()


def running_gain(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, rows: int = 12
) -> np.ndarray:
    r"""Return :math:`g_k u_k` with :math:`g_k = \sum u y / \sum u^2` over the last rows.

    >>> u = np.array([[1.0], [2.0], [3.0]])
    >>> running_gain(u, -u, np.zeros(3, bool)).round(6).tolist()  # reversed: row 0 cannot know
    [[1.0], [-2.0], [-3.0]]
    """
    from scipy.signal import lfilter  # slow to import, and only needed here

    window = np.r_[0.0, np.ones(rows)]
    # Until something was commanded, the gain is 1.
    small = 1e-12 * np.maximum.accumulate(np.square(command).clip(1e-30))
    both = lfilter(window, 1.0, command * response, axis=0) + small
    return command * both / (lfilter(window, 1.0, np.square(command), axis=0) + small)


def affine(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, forgetting: float = 0.95
) -> np.ndarray:
    """Return least squares of each response by all commands and one, older rows forgotten.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    >>> y = u @ np.array([[0.5, 0.2], [0.0, -1.0]]) + 0.3
    >>> bool(np.abs(affine(u, y, np.zeros(len(u), bool)) - y)[20:].max() < 0.03)
    True
    """
    size = command.shape[1]
    columns = [with_one(command)] * size
    return _least_squares(columns, command, response, np.eye(size, size + 1), forgetting)


def arx(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, forgetting: float = 0.95
) -> np.ndarray:
    r"""Return :math:`y_k = a y_{k-1} + b u_k + c u_{k-1} + d` by least squares, per actuator.

    >>> from scipy.signal import lfilter
    >>> u = np.random.default_rng(0).uniform(-1, 1, (80, 1))
    >>> y = lfilter([0.5], [1.0, -0.5], u, axis=0)  # a lag
    >>> bool(np.abs(arx(u, y, np.zeros(len(u), bool)) - y)[40:].max() < 0.03)
    True
    """
    # Before a border the command is supposed to have been there, and obeyed.
    first = begins | (np.arange(len(command)) == 0)
    u0, y0 = (
        np.where(first[:, None], command, np.roll(part, 1, axis=0)) for part in (command, response)
    )
    columns = [with_one(*past) for past in zip(command.T, u0.T, y0.T, strict=True)]
    prior = np.eye(4)[[0] * len(columns)]
    return _least_squares(columns, command, response, prior, forgetting, first)


SIMPLE: dict[str, Predictor] = {
    "as commanded": as_commanded,
    "gain of 3 rows": partial(running_gain, rows=3),
    "gain of 12 rows": running_gain,
    "affine least squares": affine,
    "ARX": arx,
}
"""The simple predictors, by name."""


def _least_squares(
    columns: list[np.ndarray],
    command: np.ndarray,
    response: np.ndarray,
    prior: np.ndarray,
    forgetting: float,
    skipped: np.ndarray | None = None,
    ridge: float = 0.1,
) -> np.ndarray:
    """Return each actuator's prediction by its columns ``(N, F)``, fitted to earlier rows."""
    from scipy.signal import lfilter  # slow to import, and only needed here

    earlier = partial(lfilter, [0.0, 1.0], [1.0, -forgetting], axis=0)
    predictions = np.empty_like(command)
    for j, x in enumerate(columns):
        mean = np.square(x).cumsum(0) / np.arange(1, len(x) + 1)[:, None]  # of rows so far
        weight = ridge * mean.clip(1e-100)
        fitted_to = x if skipped is None else x * ~skipped[:, None]
        gram = earlier(fitted_to[:, :, None] * fitted_to[:, None, :])
        gram += weight[:, :, None] * np.eye(x.shape[1])
        miss = response[:, j] - x @ prior[j]
        change = np.linalg.solve(gram, earlier(fitted_to * miss[:, None])[..., None])[..., 0]
        predictions[:, j] = (x * (prior[j] + change)).sum(1)
    return predictions


@dataclass(frozen=True)
class Replayed:
    """A log, what was predicted of it, and how far that was off.

    Args:
        log: what was replayed.
        predictions: of each predictor, ``(N, A)``; *as commanded* and *AFM* are among them.
        std: standard deviation that AFM gives its predictions, ``(N, A)``.
        errors: a row for each actuator, stretch of time and predictor: ``actuator``, ``stretch``,
            ``from``, ``to`` (s), ``predictor``, ``rows``, and of the absolute error ``median`` and
            ``p90`` with the ends of their 95 % intervals, ``median_low`` and so on.
        removed: share of each actuator's median error that a correction would have removed, by the
            rows that move; 0 where it may be chance, below 0 where it would have added.
        slow: actuators whose commands act in later rows, see :func:`slow_in`.
    """

    log: Log
    predictions: Mapping[str, np.ndarray]
    std: np.ndarray
    errors: pd.DataFrame
    removed: Mapping[str, float]
    slow: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """What a correction would have done."""
        removed = {name: share for name, share in self.removed.items() if share > 0}
        said = [f"{100 * removed[name]:.0f} % of the error of {name}" for name in removed]
        none = [name for name, share in self.removed.items() if share == 0]
        added = [f"{-100 * s:.0f} % to that of {name}" for name, s in self.removed.items() if s < 0]
        said += [f"none of {_listed(none)}"] if none else []
        both = [("removed", said, ","), ("added", added, "")]
        parts = [f"{done} {_listed(what, comma)}" for done, what, comma in both if what]
        return f"A correction would have {', and '.join(parts)}."

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader must know."""
        if not self.slow:
            return ()
        return (
            f"{_listed(self.slow)}: commands act in later rows. What is known of the next row is "
            "then not what another command would change at once; log rows that are as far apart as "
            "a command takes to act.",
        )

    def rows(self) -> pd.DataFrame:
        """Return a row for each row of the log: ``t``, and of each actuator four columns.

        ``command.NAME``, ``response.NAME``, ``afm.NAME`` (what the command was predicted to do) and
        ``std.NAME``; of a log of several episodes also ``episode_index``. They are NaN in rows of
        the file that could not be used. Readers of logs know these names.
        """
        log, columns = self.log, {"t": self.log.seconds}
        if log.begins.sum() > 1:
            columns["episode_index"] = log.begins.cumsum() - 1
        for j, name in enumerate(log.names):
            columns |= {
                f"command.{name}": log.command[:, j],
                f"response.{name}": log.response[:, j],
                f"afm.{name}": self.predictions[AFM][:, j],
                f"std.{name}": self.std[:, j],
            }
        table = pd.DataFrame(columns)
        if log.row is None:
            return table
        return table.set_axis(log.row).reindex(range(log.read_from or int(log.row[-1]) + 1))


def errors_of(log: Log, predictions: Mapping[str, np.ndarray], stretches: int = 4) -> pd.DataFrame:
    """Return :attr:`Replayed.errors`: of the whole log, and of stretches of equally many rows."""
    size, since = len(log), log.since
    parts = [("all", 0, size)]
    if size >= 20 * stretches:
        ends = np.linspace(0, size, stretches + 1).astype(int)
        parts += [(str(k + 1), *ends[k : k + 2]) for k in range(stretches)]
    rows = []
    for j, name in enumerate(log.names):
        for stretch, first, last in parts:
            where = {"actuator": name, "stretch": stretch}
            where |= {"from": since[first], "to": since[last - 1]}
            for predictor, predicted in predictions.items():
                miss = np.abs(predicted[first:last, j] - log.response[first:last, j])
                row = {**where, "predictor": predictor, "rows": last - first}
                for kind, share in SHARES.items():
                    low, middle, high = quantile_with_interval(miss, share)
                    row |= {kind: middle, f"{kind}_low": low, f"{kind}_high": high}
                rows.append(row)
    return pd.DataFrame(rows)


def quantile_with_interval(values: np.ndarray, share: float) -> tuple[float, float, float]:
    r"""Return lower end, quantile and upper end of its 95 % interval.

    The interval is that of order statistics: how many of N values are below the true quantile is
    binomial, with a standard deviation of :math:`\sqrt{p (1 - p) / N}` as a share. Values that
    follow each other are alike, so that N is smaller than their count: by :math:`(1 - r) / (1 + r)`
    with the correlation r of neighbours being above the quantile.

    >>> x = np.random.default_rng(0).uniform(0, 1, 10_000)
    >>> [round(end, 2) for end in quantile_with_interval(x, 0.5)]
    [0.49, 0.5, 0.51]
    """
    middle = float(np.quantile(values, share))
    above = (values > middle) - np.mean(values > middle)
    power = float(above @ above)
    alike = max(float(above[1:] @ above[:-1]) / power, 0.0) if power else 0.0
    count = max(len(values) * (1 - alike) / (1 + alike), 1.0)
    width = 1.96 * math.sqrt(share * (1 - share) / count)
    ends = np.quantile(values, np.clip([share - width, share + width], 0.0, 1.0))
    return float(ends[0]), middle, float(ends[1])


def removed_by(
    log: Log, predictions: Mapping[str, np.ndarray], least: float = 0.1
) -> dict[str, float]:
    """Return for each actuator which share of its median error a correction would have removed.

    Rows at rest do not count: there is little to remove. It is 0 where it is smaller than
    ``least``, or where the difference of the errors may be chance.
    """
    shares = {}
    for j, name in enumerate(log.names):
        rows = moving(log.command[:, j])
        alone, corrected = (
            np.abs(predictions[kind][rows, j] - log.response[rows, j]) for kind in (ALONE, AFM)
        )
        before, after = float(np.median(alone)), float(np.median(corrected))
        low, _, high = quantile_with_interval(alone - corrected, 0.5)
        share = 1 - after / before if before > 0 else 0.0
        clear = low > 0 if share > 0 else high < 0
        shares[name] = share if clear and abs(share) >= least else 0.0
    return shares


def moving(command: np.ndarray, often: float = 0.25, bins: int = 40) -> np.ndarray:
    """Return in which rows a command ``(N,)`` is not at rest: where it is in a quarter of the rows.

    All rows, if there is no such place.

    >>> moving(np.array([0.0, 0.0, 0.0, 1.0, 0.5, 0.0, -1.0]))
    array([False, False, False,  True,  True, False,  True])
    """
    counts, ends = np.histogram(command, bins)
    place = int(counts.argmax())
    low, high = ends[max(place - 1, 0)], ends[min(place + 2, bins)]
    away = (command < low) | (command > high)
    return away if counts[place] > often * len(command) and away.any() else ~np.zeros_like(away)


def slow_in(log: Log, share: float = 0.5) -> tuple[str, ...]:
    r"""Return the actuators of which less than a ``share`` of a command acts in its own row.

    By least squares, :math:`y_k = a y_{k-1} + b u_k + c u_{k-1} + d`: what acts at once is b, what
    acts in the end :math:`(b + c) / (1 - a)`.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (60, 1))
    >>> slow_in(Log(("pan",), u, 0.5 * u)), slow_in(Log(("pan",), u, np.roll(u, 1, axis=0)))
    ((), ('pan',))
    """
    slow, known = [], ~log.begins[1:]
    for name, u, y in zip(log.names, log.command.T, log.response.T, strict=True):
        a, b, c, _ = best_line(with_one(y[:-1], u[1:], u[:-1])[known], y[1:][known])
        if abs(b * (1 - a)) < share * abs(b + c):
            slow.append(name)
    return tuple(slow)


def _listed(parts: Sequence[str], before_and: str = "") -> str:
    """Return a list in words.

    >>> _listed(["a", "b", "c"]), _listed(["a"])
    ('a, b and c', 'a')
    """
    *first, last = parts
    return f"{', '.join(first)}{before_and} and {last}" if first else last
