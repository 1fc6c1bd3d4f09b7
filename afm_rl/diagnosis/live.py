"""A diagnosis in a few milliseconds, from the pairs that a corrector remembers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from afm_rl.diagnosis.findings import Actuator, Diagnosis, interval
from afm_rl.diagnosis.intervals import half_widths
from afm_rl.diagnosis.lines import left_by
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.together import in_units
from afm_rl.diagnosis.words import judge
from afm_rl.errors import ConfigurationError


def explain(
    executed: Any,
    effective: Any,
    names: Sequence[str] | None = None,
    std: Any = None,
    step: float = 1.0,
    delays: int = 5,
    fewest: int = 8,
) -> Diagnosis:
    r"""Say what pairs of executed and effective actions show of each actuator.

    Each actuator is fitted by :math:`u_\mathrm{eff} = g\,u_i(t - d) + b`, with the own command or
    another, and whole steps of delay; then other commands are looked for in what is left. Where the
    older pairs contradict the newest, only the newest half or quarter counts. Forty pairs of
    seven actuators take about four milliseconds.

    Args:
        executed: ``(K, A)``, oldest first, one row per step; numpy or torch.
        effective: their effective actions, ``(K, A)``.
        names: of the actuators.
        std: standard deviations of the effective actions, ``(K, A)``; None if all are alike.
        step: time of a step (s).
        delays: how many are tried: 0 to 4 steps.
        fewest: pairs of which something is said.

    Raises:
        ConfigurationError: for shapes that do not fit.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    >>> print(explain(u, u * [-0.5, 1.0], names=["left", "right"]))
    left: reversed, 50 % of the command
    right: healthy
    """
    u, y = np.asarray(executed, dtype=float), np.asarray(effective, dtype=float)
    weight = np.ones_like(y) if std is None else np.asarray(std, dtype=float)
    if u.ndim != 2 or u.shape != y.shape or u.shape != weight.shape:
        raise ConfigurationError(
            f"explain: executed {u.shape}, effective {y.shape}, std {weight.shape}: expected "
            "three arrays (K, A) of one shape"
        )
    size = u.shape[1]
    names = [str(k) for k in range(size)] if names is None else list(names)
    if len(names) != size:
        raise ConfigurationError(f"explain: {len(names)} names: expected {size}, one per action")
    if std is not None:
        weight = 1 / (weight**2 + (0.1 * np.ptp(u, 0).clip(1e-9)) ** 2)
    sound = np.isfinite(u).all(1) & np.isfinite(y).all(1) & np.isfinite(weight).all(1)
    u, y, weight = u[sound], y[sound], weight[sound]
    if len(u) < fewest:
        unknown = [judge(Actuator(name=name, rows=len(u))) for name in names]
        return Diagnosis(actuators=tuple(unknown), step_s=step, rows=len(u))
    late = np.zeros((delays, *u.shape))
    for delay in range(delays):
        late[delay, delay:] = u[: len(u) - delay]
    fits = [[_fit(late, y[:, j], weight[:, j], j, names, step, fewest)] for j in range(size)]
    actuators, notes = in_units(fits, Settings())
    judged = tuple(judge(actuator, step) for (actuator,) in actuators)
    return Diagnosis(actuators=judged, step_s=step, rows=len(u), notes=notes, common=notes)


def describe(
    pairs: np.ndarray | None,
    names: Sequence[str],
    step: float = 1.0,
    delay: int = 0,
    known: int = 0,
    compensated: bool = False,
) -> str:
    """Say in words what pairs show of each actuator, and how late actions are.

    Args:
        pairs: executed and effective actions and the standard deviations of these, side by side,
            ``(K, 3 A)``, oldest first, in the unit of the actions; None where nothing has changed.
        names: of the A actuators.
        step: time of a step (s).
        delay: steps from an action to its effect.
        known: how many of them the pairs already take into account.
        compensated: is it made up for?

    >>> describe(None, ["pan"], delay=2, compensated=True).splitlines()
    ['healthy', 'lateness: 2 steps, made up for']
    """
    text = "healthy"
    if pairs is not None:
        executed, effective, std = np.split(pairs, 3, axis=1)
        delays = max(5, delay - known + 1)
        text = str(explain(executed, effective, names, std=std, step=step, delays=delays))
    if delay:
        text += f"\nlateness: {delay} step{'s' * (delay > 1)}{', made up for' * compensated}"
    return text


def _fit(
    late: np.ndarray,
    y: np.ndarray,
    weight: np.ndarray,
    own: int,
    names: Sequence[str],
    step: float,
    fewest: int,
    stale: float = 9.0,
    visible: float = 5.0,
    rounding: float = 1e-4,
) -> Actuator:
    """Fit one actuator's effects ``(K,)`` by the commands, ``(D, K, A)`` with each delay.

    Older pairs were another regime if their squared residual is ``stale`` times the newest's.
    Another command has to show by ``visible`` standard errors; a residual below ``rounding``, a
    share of the range of commands, is rounding.
    """
    rows, delays = len(y), len(late)
    shortest, rounded = delays + fewest, float((10 * rounding) ** 2 * late[0].var(0).max())
    for share in (4, 2, 1):  # the newest quarter, half, all
        first = max(rows - max(rows // share, shortest), min(delays - 1, rows - fewest))
        line = _line(late[:, first:], y[first:], weight[first:], own, rounding)
        if share == 4:
            newest, start = line, first
        elif first < start and line[-1] > stale * max(newest[-1], rounded):
            break
        best, start = line, first
    delay, driver, gain, offset, _ = best
    x, y, weight = late[delay, start:], y[start:], weight[start:]
    residual = y - gain * x[:, driver] - offset
    coupling, used = {}, [driver]
    spread = x.std(0)
    whole = (weight[:, None] * (x - x.mean(0)) ** 2).sum(0)
    for _ in range(x.shape[1] - 1 if driver == own else 0):
        rest = left_by(np.column_stack([x[:, used], np.ones(len(x))]), x)
        power = (weight[:, None] * rest**2).sum(0)
        slope = (weight * residual) @ rest / np.maximum(power, 1e-300)
        error = np.sqrt((residual**2).mean() / np.maximum((rest**2).sum(0), 1e-300))
        clear = (np.abs(slope) > visible * error) & (power > 0.01 * whole)
        clear &= np.abs(slope) * spread > Settings().matters * max(spread[own], rounding)
        clear[used] = False
        if not clear.any() or len(x) < len(used) + fewest:
            break
        used.append(int(np.argmax(np.where(clear, slope**2 * power, -1.0))))
        design = np.column_stack([x[:, used], np.ones(len(x))])
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(root * design, root[:, 0] * y, rcond=None)[0]
        residual = y - design @ solution
        gain, offset = solution[0], solution[-1]
        coupling = {names[i]: float(g) for i, g in zip(used[1:], solution[1:-1], strict=True)}
    design = np.column_stack([x[:, used], np.ones(len(x))])
    gram = (design * weight[:, None]).T @ design
    inverse = np.linalg.inv(gram + 1e-12 * gram.trace() * np.eye(len(gram)))
    pull = (design * weight[:, None]) @ inverse
    influence = pull * (residual / (1 - (pull * design).sum(1)))[:, None]
    low, high = float(x[:, driver].min()), float(x[:, driver].max())
    middle, at_zero = 0.5 * (low + high), influence[:, -1]
    three = np.column_stack([influence[:, 0], at_zero, at_zero + middle * influence[:, 0]])
    width = half_widths(three) if high > low else np.full(3, np.inf)
    freedom = max(len(x) - design.shape[1], 1)
    level = gain * middle + offset
    others = max(coupling, key=lambda name: abs(coupling[name])) if coupling else None
    total = y.var()
    return Actuator(
        name=names[own],
        gain=float(gain),
        gain_interval=interval(gain - width[0], gain + width[0]),
        reversed=bool(gain + width[0] < 0),
        offset=float(offset),
        offset_interval=interval(offset - width[1], offset + width[1]),
        level=float(level),
        level_interval=interval(level - width[2], level + width[2]),
        delay_s=delay * step,
        driven_by=others if driver == own else names[driver],
        coupling=coupling,
        noise=float(np.sqrt((weight * residual**2).sum() / freedom / weight.mean())),
        unexplained=float(min(residual.var() / total, 1.0)) if total else 0.0,
        command_range=(low, high),
        rows=len(x),
    )


def _line(
    x: np.ndarray, y: np.ndarray, weight: np.ndarray, own: int, rounding: float, better: float = 0.5
) -> tuple[int, int, float, float, float]:
    """Return delay, driver, gain, offset and squared residual of the best line.

    Args:
        x: commands with each delay, ``(D, K, A)``.
        y: effects, ``(K,)``.
        weight: of the pairs, ``(K,)``.
        own: index of the actuator's own command.
        rounding: residuals below this share of the range of commands are rounding.
        better: share of the squared residual that another delay or command may leave.
    """
    share = weight / weight.sum()
    mean, level = share @ x, share @ y  # (D, A)
    centred, moved = x - mean[:, None], y - level
    power = share @ centred**2
    slope = (share * moved) @ centred / np.maximum(power, 1e-12)
    squared = np.maximum((share * moved) @ moved - slope**2 * power, 0.0)
    squared += rounding**2 * np.maximum(power.max(), 1e-300)
    # the own command without delay, unless another is clearly better
    clear = squared[:, own].min() < better * squared[0, own]
    best = (int(squared[:, own].argmin()) if clear else 0, own)
    other = np.unravel_index(squared.argmin(), squared.shape)
    if squared[other] < better**2 * squared[best]:
        best = (int(other[0]), int(other[1]))
    gain = float(slope[best])
    return best[0], best[1], gain, float(level - gain * mean[best]), float(squared[best])
