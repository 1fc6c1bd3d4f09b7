"""Contexts of the Actuator Inversion Benchmark: bodies and signs of each split."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from afm_rl.envs.task.task import Contexts

VALUES = 50  # of a parameter, in each split
Span = tuple[float, float]


def spread(inner: Span, outer: Span) -> dict[str, np.ndarray]:
    """Return 50 values of a parameter for each split, from its training and its whole range.

    >>> {name: values[[0, -1]].round(3).tolist() for name, values in spread((1, 2), (0, 4)).items()}
    {'train': [1.0, 2.0], 'in': [1.01, 1.99], 'out': [0.0, 4.0]}
    """
    low, high = inner
    margin, half = 0.01 * (high - low), VALUES // 2
    below = np.linspace(outer[0], low, half, endpoint=False)
    above = np.linspace(outer[1], high, half, endpoint=False)[::-1]
    return {
        "train": np.linspace(low, high, VALUES),
        "in": np.linspace(low + margin, high - margin, VALUES),
        "out": np.concatenate([below, above]),
    }


def body_regime(size: int, sign: float, *values: float, **units: float) -> dict[str, float]:
    """Return the regime of a body with A = ``size`` actuators; ``units`` are nominal values.

    >>> body_regime(1, -1.0, 0.75, length=0.5)
    {'length': 1.5, 'gain_0': -1.0}
    """
    pairs = zip(values, units.items(), strict=False)  # no values: the nominal ones
    factors = {name: value / unit for value, (name, unit) in pairs}
    return factors | ({} if sign == 1 else {f"gain_{axis}": sign for axis in range(size)})


def contexts_of(
    spans: Mapping[str, tuple[Span, Span]],
    regime: Callable[..., Mapping[str, float]],
    signs: Sequence[float],
    count: int,
) -> Contexts:
    """Return pairs of regimes, before and after a change, of each split.

    The values of all parameters are crossed, with the signs too, sorted, and ``count`` of them
    taken at equal distances. ``train``, ``in`` and ``out`` are as published, with both signs;
    ``train_reversed`` and so on have only the reversed sign; ``nominal`` and ``reversed`` are the
    nominal body.

    Args:
        spans: training and whole range of each parameter.
        regime: ``regime(sign, *values)``; without values that of the nominal body.
        signs: of the actions.
        count: contexts of a split.
    """
    contexts: dict[str, list] = {"nominal": [({}, {})], "reversed": [({}, regime(-1.0))]}
    splits = [spread(*span) for span in spans.values()]
    for name in splits[0]:
        values = np.meshgrid(*(split[name] for split in splits), indexing="ij")
        grid = np.stack([part.ravel() for part in values], -1)
        for suffix, own in (("", signs), ("_reversed", (-1.0,))):
            rows = [(*row, sign) for row in grid.tolist() for sign in sorted(own)]
            chosen = np.linspace(0, len(rows) - 1, count).round().astype(int)
            contexts[name + suffix] = [
                (regime(1.0, *row), regime(sign, *row))
                for *row, sign in (rows[index] for index in chosen)
            ]
    return contexts
