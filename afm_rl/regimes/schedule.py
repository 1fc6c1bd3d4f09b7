"""When a regime starts and ends."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number
from afm_rl.options import options


class Schedule:
    """Breakpoints between the phases of a mission, by progress or by step.

    With K breakpoints a mission has K + 1 phases; phase k + 1 begins once the measure is
    *greater than* breakpoint k.

    Args:
        at: increasing breakpoints.

    >>> schedule = Schedule([0.15, 0.80])
    >>> schedule.phase(torch.tensor([0.1, 0.5, 0.9]), torch.zeros(3))
    tensor([0, 1, 2])
    """

    @options("schedule")
    def __init__(
        self,
        at: Sequence[float] = (0.15, 0.80),
        by: Annotated[Literal["progress", "step"], "progress: of targets or episode"] = "progress",
    ) -> None:
        self.by = by
        high = 1.0 if by == "progress" else float("inf")
        self.at = tuple(check_number("schedule.at", value, low=0.0, high=high) for value in at)
        if list(self.at) != sorted(self.at):
            raise ConfigurationError(f"schedule.at={list(at)}: expected increasing breakpoints")

    @property
    def phases(self) -> int:
        """Number of phases, K + 1."""
        return len(self.at) + 1

    def padded(self, phases: int) -> Schedule:
        """Return a schedule with room for ``phases`` phases, which do not begin of themselves.

        >>> Schedule([0.5]).padded(4).at
        (0.5, inf, inf)
        """
        roomy = copy.copy(self)
        roomy.at = self.at + (math.inf,) * (phases - self.phases)
        return roomy

    def phase(self, progress: Tensor, step: Tensor, at: Tensor | None = None) -> Tensor:
        """Return the phase index ``(*B)`` for progress in [0, 1] and step number.

        ``at`` ``(*B, K)`` gives each mission breakpoints of its own; pad with ``inf``.
        """
        measure = progress if self.by == "progress" else step
        if at is None:
            at = torch.tensor(self.at, device=measure.device, dtype=progress.dtype)
        return (measure.unsqueeze(-1) > at).sum(-1)


def phase_parameters(parameters: Tensor, phase: Tensor) -> Tensor:
    """Pick each mission's row ``(*B, F)`` out of ``(*B, P, F)`` by phase ``(*B)``."""
    index = phase[..., None, None].expand(*phase.shape, 1, parameters.shape[-1])
    return parameters.gather(-2, index).squeeze(-2)


def blend_phases(parameters: Tensor, phase: Tensor, age: Tensor, ramp: Tensor) -> Tensor:
    r"""Move from the last phase's row to the present one's, ``(*B, F)``.

    .. math:: \rho = (1 - w)\,\rho_{k-1} + w\,\rho_k,\qquad w = \min(t / T, 1)

    Args:
        parameters: rows :math:`\rho` of all phases, ``(*B, P, F)``.
        phase: index k of the present phase, ``(*B)``.
        age: steps t since it began, ``(*B)``.
        ramp: steps T that the change takes, ``(*B)``; 0 for a sudden one.

    >>> rows = torch.tensor([[1.0], [-1.0]])
    >>> blend_phases(rows, torch.tensor(1), torch.tensor(3), torch.tensor(4))
    tensor([-0.5000])
    """
    last = phase_parameters(parameters, (phase - 1).clamp(min=0))
    now = phase_parameters(parameters, phase)
    share = (age / ramp.clamp(min=1)).clamp(0.0, 1.0)
    weight = torch.where(ramp > 0, share, 1.0).to(now.dtype)
    return torch.lerp(last, now, weight.unsqueeze(-1))
