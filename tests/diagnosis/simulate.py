"""Logs of actuators with known faults; what these do is written without the package, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afm_rl.diagnosis import Log, diagnose


@dataclass
class Fault:
    """What one actuator does."""

    gain: float = 1.0
    offset: float = 0.0
    dead_zone: float = 0.0
    saturation: float | None = None
    backlash: float = 0.0
    delay: float = 0.0  # steps
    lag: float = 0.0  # steps
    source: int | None = None
    coupling: tuple[int, float] | None = None
    quantum: float = 0.0
    drift: float = 0.0  # of the offset, from begin to end


def commands(rng, rows, size, kind="smooth"):
    """Return commands between about -1 and 1, ``(rows, size)``, of a generator or a seed."""
    rng, t = np.random.default_rng(rng), np.arange(rows)[:, None]
    if kind == "white":
        return rng.uniform(-1, 1, (rows, size))
    if kind == "steps":
        hold = rng.integers(5, 30)
        return np.repeat(rng.uniform(-1, 1, (rows // hold + 1, size)), hold, axis=0)[:rows]
    if kind == "walk":
        u = np.zeros((rows, size))
        for k in range(1, rows):
            u[k] = 0.95 * u[k - 1] + 0.3 * rng.standard_normal(size)
        return np.clip(u, -1, 1)
    waves = np.zeros((rows, size))
    for _ in range(4):
        period = rng.uniform(15, 150, size)
        waves += rng.uniform(0.2, 0.5, size) * np.sin(2 * np.pi * (t / period + rng.random(size)))
    return waves


def steps(seed, rows, size=1, hold=10, low=-1.0, high=1.0):
    """Return commands that hold for some rows each, ``(rows, size)``."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(low, high, (rows // hold + 1, size)), hold, axis=0)[:rows]


def respond(u, fault: Fault, j: int):
    """Return the response ``(rows,)`` without noise."""
    own = u[:, j if fault.source is None else fault.source]
    rows = np.arange(len(u), dtype=float)
    x = np.interp(rows - fault.delay, rows, own)
    if fault.backlash:
        y = x[0]
        out = []
        for value in x:
            y = min(max(y, value - fault.backlash), value + fault.backlash)
            out.append(y)
        x = np.array(out)
    if fault.saturation is not None:
        x = np.clip(x, -fault.saturation, fault.saturation)
    x = np.sign(x) * np.maximum(np.abs(x) - fault.dead_zone, 0.0)
    y = fault.gain * x
    if fault.coupling is not None:
        other, share = fault.coupling
        y = y + share * np.interp(rows - fault.delay, rows, u[:, other])
    if fault.lag:
        keep, out = np.exp(-1 / fault.lag), [y[0]]
        for value in y[1:]:
            out.append(value + keep * (out[-1] - value))
        y = np.array(out)
    y = y + fault.offset + fault.drift * rows / len(rows)
    return np.round(y / fault.quantum) * fault.quantum if fault.quantum else y


def servo(u, rate, delay=0, share=1.0):
    """Return what moves towards commands ``(N, A)`` by at most ``rate`` a row."""
    y = u.copy()
    for k in range(1, len(u)):
        y[k] = y[k - 1] + np.clip(share * (u[max(k - delay, 0)] - y[k - 1]), -rate, rate)
    return y


def noise(rng, rows, size, scale=0.02, kind="gauss"):
    if kind == "heavy":
        return scale * rng.standard_t(2.5, (rows, size))
    if kind == "red":
        e = scale * rng.standard_normal((rows, size))
        for k in range(1, rows):
            e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * e[k]
        return e
    return scale * rng.standard_normal((rows, size))


def log_of(u, y, names=None, scale=0.01, seed=0, **how):
    """Return a log with Gaussian noise in its responses, a column where there is one actuator."""
    u, y = (x[:, None] if x.ndim == 1 else x for x in (u, y))
    names = names or tuple(f"joint_{k}" for k in range(u.shape[1]))
    return Log(names, u, y + noise(np.random.default_rng(seed), *y.shape, scale), **how)


def said(log):
    """Return what is said of each actuator, without its name."""
    return [actuator.sentence.partition(": ")[2] for actuator in diagnose(log).actuators]


def explain(u, y, names=None, step=1.0):
    """Return the diagnosis of pairs of executed and effective actions."""
    u, y = np.asarray(u), np.asarray(y)
    names = tuple(names or map(str, range(u.shape[1])))
    rows = np.arange(len(u))
    return diagnose(Log(names, u, y, step * rows, row=rows, computed=True))
