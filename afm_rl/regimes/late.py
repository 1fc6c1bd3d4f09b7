"""Commands that act late: delay, lag, backlash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, options
from afm_rl.regimes.base import HalfRange, Regime, check_span, same_command

MOST_STEPS = 25


class Delay(Regime):
    r"""The command of d steps ago: :math:`a_\mathrm{eff} = a_{t - d}`, with d up to 25.

    Between whole steps, as in a ramp, the neighbouring commands are mixed linearly. Without
    the previous commands there is no delay, and so the inverse is the action itself. The
    prior draws whole steps.

    >>> late = Delay()
    >>> past = torch.tensor([[0.2, 0.0], [0.1, 0.0]] + 6 * [[0.0, 0.0]])  # newest first
    >>> late.apply(torch.ones(2), late.encode({"delay": 2}), torch.zeros(3), past)
    tensor([0.1000, 0.0000])
    """

    names = ("delay",)
    identity = (0.0,)
    limits = {"delay": (0.0, MOST_STEPS)}
    history = MOST_STEPS
    command_for = same_command

    @options("")
    def __init__(
        self,
        span: Annotated[Sequence[Count], "lowest and highest delay drawn, steps"] = (1, 2),
    ) -> None:
        low, high = check_span("span", span, 1, MOST_STEPS)
        self.steps = int(low), int(high)

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        commands = torch.cat([action.unsqueeze(-2), past], -2)
        steps = torch.arange(commands.shape[-2], device=action.device)
        shares = (1 - (parameters - steps).abs()).clamp(min=0.0)
        return (shares.unsqueeze(-1) * commands).sum(-2)

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row; only whole steps are allowed."""
        row = super().encode(values)
        if float(row) % 1:
            given = values["delay"]
            raise ConfigurationError(f"regimes: delay={given!r}: expected whole steps")
        return row

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        low, high = self.steps
        return torch.randint(low, high + 1, (*shape, 1), generator=generator).float()


SLOWEST = 8.0  # steps
History = Annotated[Count, "commands in the memory"]


class Lag(Regime):
    r"""A low-pass filter of first order with a time constant of T steps, the same on all axes.

    .. math:: y_t = a_t + e^{-1 / T} (y_{t-1} - a_t)

    T = 0 means no lag. y starts at the oldest command in the memory. Without previous commands
    there is no lag.

    Args:
        span: lowest and highest time constant T (steps) in the prior, uniform.

    >>> import torch
    >>> slow, past = Lag(history=3), torch.zeros(3, 1)
    >>> slow.apply(torch.ones(1), slow.encode({"lag": 1.0}), torch.zeros(3), past)
    tensor([0.6321])
    """

    names = ("lag",)
    identity = (0.0,)
    limits = {"lag": (0.0, SLOWEST)}
    command_for = same_command

    @options("")
    def __init__(self, span: Sequence[float] = (0.5, 3.0), history: History = 8) -> None:
        self.span = check_span("span", span, 0.0, SLOWEST)
        self.history = history

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        keep = (-1 / parameters.abs()).exp()  # 0 where there is no lag
        oldest, *later = reversed(past.unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = command + keep * (effect - command)
        return effect


class Backlash(Regime):
    r"""The play operator, the same width on all axes: a hysteresis.

    .. math:: y_t = \min(\max(y_{t-1}, u_t - b), u_t + b)

    u are commands in half ranges. y starts at the oldest command in the memory. Without
    previous commands there is no backlash.

    Args:
        half_range: half ranges of the action axes.
        span: lowest and highest half width b in the prior, uniform.

    >>> loose = Backlash(half_range=[1.0], history=2)
    >>> past = torch.tensor([[0.5], [0.0]])  # newest first: up to 0.5 - 0.2, then back
    >>> loose.apply(torch.tensor([0.2]), loose.encode({"backlash": 0.2}), torch.zeros(3), past)
    tensor([0.3000])
    """

    names = ("backlash",)
    identity = (0.0,)
    limits = {"backlash": (0.0, 1.0)}
    command_for = same_command

    @options("")
    def __init__(
        self,
        half_range: Sequence[float],
        span: Sequence[float] = (0.05, 0.3),
        history: History = 8,
    ) -> None:
        self.half_range = HalfRange(half_range)
        self.span = check_span("span", span, 0.0, 1.0)
        self.history = history

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        width = parameters * self.half_range.like(action)
        oldest, *later = reversed(past.unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = torch.minimum(torch.maximum(effect, command - width), command + width)
        return effect
