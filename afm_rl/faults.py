"""Faulty readings and unsafe actions: pure functions for transforms, updaters and loops.

A reading is *whole* if all its numbers are finite and of a possible size. It is *stale* if the
sensor has sent the previous reading again. Code that keeps transitions keeps the number of
repetitions beside the state and asks for both ends of a transition::

    after = count_repeats(next_state, state, count)
    valid = trusted(state, count) & trusted(next_state, after)

Both ends count: the first fresh reading after a stale one seems to be a jump.

How a stale sensor and a robot that stands still differ:

* With a time stamp: the reading is stale if and only if the stamp stands still.
* Without one: real sensors and noisy simulators never send the same bits twice, so a reading
  that is bit-equal in all coordinates counts as stale. A robot that does not move in a
  simulator without noise looks the same. Therefore only the first ``patience`` repetitions in a
  row count as stale; after that the reading is taken for true, and its transitions say that the
  actuators are dead. Until then nothing wrong is learned, only less. Where noise is certain, use
  ``patience=math.inf``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError

PATIENCE = 20  # repetitions in a row that count as a stale sensor


def whole(reading: Tensor, absurd: float = 1e12, keepdim: bool = False) -> Tensor:
    """Return whether readings ``(*B, S)`` are finite and of a possible size, ``(*B)``.

    What is ``absurd`` in any unit is a fault, also where an angle would wrap it.

    >>> whole(torch.tensor([[1.0, 2.0], [1.0, torch.nan], [1e30, 0.0]]))
    tensor([ True, False, False])
    """
    return (reading.abs() < absurd).all(-1, keepdim)  # false for NaN


def finite(numbers: Tensor) -> Tensor:
    """Return whether all numbers of rows ``(*B, N)`` are finite, ``(*B)``.

    >>> finite(torch.tensor([[1.0, 2.0], [1.0, torch.nan], [torch.inf, 0.0]]))
    tensor([ True, False, False])
    """
    return whole(numbers, math.inf)


def count_repeats(
    reading: Tensor,
    last: Tensor,
    count: Tensor,
    stamp: Tensor | None = None,
    last_stamp: Tensor | None = None,
) -> Tensor:
    """Return how many times in a row the sensor has sent this reading again, ``(*B)``.

    Args:
        reading: the present reading, ``(*B, S)``.
        last: the reading before, ``(*B, S)``.
        count: what this function returned for it, ``(*B)``, or ``(*B, 1)``, as what is returned;
            0 at first.
        stamp: time of the present reading, ``(*B)``; None where there is none.
        last_stamp: time of the reading before.

    >>> count_repeats(torch.ones(2, 3), torch.tensor([[1.0], [2.0]]), torch.tensor([4, 4]))
    tensor([5, 0])
    """
    if stamp is not None and last_stamp is not None:
        return torch.where(stamp == last_stamp, count + 1, 0)
    again = (reading == last).all(-1, keepdim=count.dim() == reading.dim())
    return again * (count + 1)


def trusted(reading: Tensor, count: Tensor, patience: float = PATIENCE) -> Tensor:
    """Return whether readings ``(*B, S)`` are whole and not stale, ``(*B)``.

    Args:
        reading: the readings.
        count: see :func:`count_repeats`; the result has its shape.
        patience: repetitions in a row that count as a stale sensor; infinite with time stamps.

    >>> trusted(torch.zeros(3, 2), torch.tensor([0, 1, 21]))
    tensor([ True, False,  True])
    """
    fresh = (count == 0) | (count > patience)
    return whole(reading, keepdim=count.dim() == reading.dim()) & fresh


def check_numbers(key: object, given: Any, shape: Sequence[int] | None = None) -> Tensor:
    """Return what was found under a key, if it is a tensor of real numbers of a shape.

    Args:
        key: where it was found.
        given: what was found.
        shape: of the tensor; None: any.

    Raises:
        ConfigurationError: otherwise, naming key, what was found and what was expected.

    >>> check_numbers("action", torch.ones(2), (2,))
    tensor([1., 1.])
    >>> check_numbers("action", torch.ones(2), (3,))
    Traceback (most recent call last):
    afm_rl.errors.ConfigurationError: 'action': torch.float32 (2,), expected real numbers (3,)
    """
    if isinstance(given, Tensor):
        real = not given.is_complex() and given.dtype is not torch.bool
        if real and (shape is None or given.shape == torch.Size(shape)):
            return given
        found = f"{given.dtype} {tuple(given.shape)}"
    else:
        found = type(given).__name__
    size = "" if shape is None else f" {tuple(shape)}"
    raise ConfigurationError(f"{key!r}: {found}, expected real numbers{size}")


def safe_action(action: Tensor, low: Tensor, high: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions that can be executed ``(*B, A)``, and where the last one is held ``(*B)``.

    Args:
        action: any action.
        low: lowest action, ``(A,)`` or more dimensions.
        high: highest action.
        last: what is executed where ``action`` has a number that is not finite, ``(*B, A)``.

    >>> low, high = -torch.ones(2), torch.ones(2)
    >>> wild = torch.tensor([[3.0, 0.5], [torch.nan, 0.0]])
    >>> safe_action(wild, low, high, torch.zeros(2, 2))
    (tensor([[1.0000, 0.5000],
            [0.0000, 0.0000]]), tensor([False,  True]))
    """
    held = ~finite(action)
    sound = torch.where(held.unsqueeze(-1), last.nan_to_num(), action.to(last.dtype))
    return sound.clamp(low, high), held
