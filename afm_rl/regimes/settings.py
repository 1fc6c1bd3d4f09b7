"""What families are set up with: half ranges of the actions, and ranges to draw from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number

MOST = 10.0  # half ranges: more are typing errors


class Constant:
    """A row of numbers as a tensor of any type and on any device, made once for each.

    >>> Constant([1, 2]).like(torch.zeros(2, dtype=torch.float64))
    tensor([1., 2.], dtype=torch.float64)
    """

    def __init__(self, values: Iterable[float]) -> None:
        self.values = tuple(float(value) for value in values)
        self._tensors: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def like(self, other: Tensor) -> Tensor:
        """Return the numbers ``(N,)`` with type and device of ``other``."""
        key = other.dtype, other.device
        if key not in self._tensors:
            self._tensors[key] = other.new_tensor(self.values)
        return self._tensors[key]


class HalfRange(Constant):
    """Half ranges of the A action axes, the unit of many parameters, where they are needed.

    Args:
        values: half of highest minus lowest action, per axis.

    Raises:
        ConfigurationError: unless all are finite and above zero.

    >>> HalfRange([1.0, 1.5]).values
    (1.0, 1.5)
    """

    def __init__(self, values: Sequence[float]) -> None:
        given = list(values) if isinstance(values, Sequence) else []
        numbers = [x for x in given if isinstance(x, (int, float)) and 0 < x < math.inf]
        if not given or len(numbers) < len(given):
            raise ConfigurationError(
                f"half_range={values!r}: expected a finite number above 0 per action axis, half "
                "of action_high - action_low"
            )
        super().__init__(given)


def check_span(
    name: str, span: Sequence[float], low: float = -math.inf, high: float = math.inf
) -> tuple[float, float]:
    """Return the two ends of a range to draw from.

    Raises:
        ConfigurationError: unless they are two finite numbers in [low, high], in order.

    >>> check_span("span", [0.2, 0.6], low=0.0)
    (0.2, 0.6)
    """
    if isinstance(span, str) or not isinstance(span, Sequence) or len(span) != 2:
        raise ConfigurationError(f"{name}={span!r}: expected two numbers, lowest and highest")
    first, last = (check_number(name, value, low=low, high=high) for value in span)
    if first > last:
        raise ConfigurationError(f"{name}={span!r}: expected the lower number first")
    return first, last


def draw_between(
    span: tuple[float, float], size: tuple[int, ...], generator: torch.Generator | None
) -> Tensor:
    """Draw numbers of shape ``size``, uniform in the range.

    >>> draw_between((2.0, 2.0), (3,), None)
    tensor([2., 2., 2.])
    """
    low, high = span
    return low + (high - low) * torch.rand(size, generator=generator)
