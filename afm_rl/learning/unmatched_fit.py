"""The unmatched part of a calibration: what no action can undo."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.learning.error_decomposition import ErrorParts
from afm_rl.learning.least_squares import fading, least_squares
from afm_rl.learning.regime_memory import Memory, Rules, Seen, advance, empty, latest, where
from afm_rl.mission_state import MissionState

OFFSET = 100.0  # spread of the prior of c, in standard deviations of the model


class Offsets(NamedTuple):
    """Transitions as measurements of c, in standard deviations of the model."""

    across: Tensor
    """What a transition shows of c, ``(l, K, D, D)``."""
    total: Tensor
    """What it showed, ``(l, K, D)``."""
    noise: Tensor
    """The model's standard deviation, ``(l, K, D)``."""


class UnmatchedFit(nn.Module):
    """c per mission, from errors that no action explains.

    Args:
        size: of the tangent space, D.
        rules: of the memory.
    """

    def __init__(self, size: int, rules: Rules) -> None:
        super().__init__()
        self.size, self.rules = size, rules
        self.memory, self.rows = (MissionState(p) for p in self._empty(0, torch.device("cpu")))

    def clear(self, missions: int, device: torch.device) -> None:
        """Forget everything."""
        memory, rows = self._empty(missions, device)
        self.memory.keep(memory)
        self.rows.keep(rows)

    def learn(self, offset: Tensor, parts: ErrorParts, valid: Tensor) -> None:
        """Take in n transitions per mission.

        Args:
            offset: c, as it was when the errors were measured, ``(l, 1, D)``.
            parts: of the errors, ``(l, n, ...)``.
            valid: which transitions count, ``(l, n)``.
        """
        memory: Memory = self.memory.parts
        theta, covariance = self._fit()
        across = parts.projection / parts.noise.unsqueeze(-2)
        total = parts.unmatched + (across @ offset.unsqueeze(-1)).squeeze(-1)
        error = total - (across @ theta.unsqueeze(-1)).squeeze(-1)
        variance = (across @ covariance * across).sum(-1)
        variance = where(memory.active, variance, torch.zeros_like(variance))
        errors = error / (1 + variance).sqrt(), error, total
        innovation, error, nominal = (part.abs().amax(-1) for part in errors)
        seen = Seen(innovation, error, nominal, torch.ones_like(valid), valid)
        memory, _ = advance(memory, seen, self.rules, self.size)
        pairs = zip(self.rows.parts, (across, total, parts.noise), strict=True)
        rows = [torch.cat(pair, 1) for pair in pairs]
        memory, rows = latest(memory, rows, self.rules.window * valid.shape[1])
        self.memory.keep(memory)
        self.rows.keep(Offsets(*rows))

    def calibration(self) -> Tensor:
        """Return the c ``(l, D)`` to use now."""
        theta, _ = self._fit()
        return where(self.memory.parts.better, theta, torch.zeros_like(theta)).squeeze(1)

    def _empty(self, missions: int, device: torch.device) -> tuple[Memory, Offsets]:
        memory = empty(missions, device)
        row = memory.level.new_zeros(missions, 0, self.size)
        return memory, Offsets(row.unsqueeze(-1).expand(-1, -1, -1, self.size), row, row)

    def _fit(self) -> tuple[Tensor, Tensor]:
        """Return mean ``(l, 1, D)`` and covariance ``(l, 1, D, D)`` of c."""
        memory, (across, total, noise) = self.memory.parts, self.rows.parts
        counts = (memory.share > 0).unsqueeze(-1)
        typical = torch.where(counts, noise, 0.0).sum(1) / counts.sum(1).clamp_min(1)
        width = OFFSET * torch.where(typical > 0, typical, 1.0)
        prior = fading(width.square().reciprocal().unsqueeze(1), memory.age)
        weight = memory.share.repeat_interleave(self.size, 1).unsqueeze(-1)
        rows = across.flatten(1, 2), total.flatten(1).unsqueeze(-1)
        return least_squares(*rows, weight, prior, torch.zeros_like(prior))
