"""Delay: commands arrive late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_counts
from afm_rl.regimes.base import DelayedRegime

MOST_STEPS = 10


class Delay(DelayedRegime):
    r"""The command of d steps ago: :math:`a_\mathrm{eff} = a_{t - d}`, with d up to 10.

    Between whole steps, as in a ramp, the neighbouring commands are mixed linearly. Without
    the previous commands there is no delay, and so the inverse is the action itself. The
    prior draws whole steps.

    Args:
        span: lowest and highest delay in the prior (steps).

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> late = Delay()
    >>> past = torch.tensor([[0.2, 0.0], [0.1, 0.0]] + 6 * [[0.0, 0.0]])  # newest first
    >>> late.apply(torch.ones(2), late.encode({"delay": 2}), torch.zeros(3), past)
    tensor([0.1000, 0.0000])
    """

    names = ("delay",)
    identity = (0.0,)
    limits = {"delay": (0.0, MOST_STEPS)}
    history = MOST_STEPS

    def __init__(self, span: Sequence[int] = (1, 2)) -> None:
        self.steps = check_counts("span", span)
        if len(self.steps) != 2 or not self.steps[0] <= self.steps[1] <= MOST_STEPS:
            raise ConfigurationError(
                f"span={list(span)}: expected two numbers of steps, 1 <= lowest <= highest <= "
                f"{MOST_STEPS}"
            )

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        """Pick the command out of the past."""
        effect = action * (1 - parameters).clamp(min=0.0)
        for steps, command in enumerate(past.unbind(-2), 1):
            effect = effect + command * (1 - (parameters - steps).abs()).clamp(min=0.0)
        return effect

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row; only whole steps are taken.

        Raises:
            ConfigurationError: also for a fraction of a step.
        """
        row = super().encode(values)
        if float(row) % 1:
            given = values["delay"]
            raise ConfigurationError(f"regimes: delay={given!r}: expected whole steps")
        return row

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        low, high = self.steps
        return torch.randint(low, high + 1, (*shape, 1), generator=generator).float()
