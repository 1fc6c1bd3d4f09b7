"""The unmatched part of a calibration: what no action can undo."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from afm_rl.learning.effects import Effect
from afm_rl.learning.kept import Kept
from afm_rl.learning.recursive_least_squares import Information, fading, solve
from afm_rl.learning.regime_memory import Memory, Rules, advance, blank, pooled, where

OFFSET = 100.0  # spread of the prior of c, in standard deviations of the model


class UnmatchedFit(nn.Module):
    """c per mission, from errors that no action explains.

    Args:
        size: of the tangent space, D.
        rules: of the memory.
    """

    def __init__(self, size: int, rules: Rules) -> None:
        super().__init__()
        self.size, self.rules = size, rules
        self.memory = Kept(blank(0, 1, size, torch.zeros(0)))
        self.register_buffer("prior", torch.ones(0, 1, size, dtype=torch.float64), persistent=False)

    def clear(self, missions: int, like: Tensor) -> None:
        """Forget everything."""
        self.memory.keep(blank(missions, 1, self.size, like))
        self.prior = torch.ones_like(self.memory.parts.moment)

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index``."""
        self.memory.select_(index)
        self.prior = self.prior[index]

    def learn(self, told: Tensor, effect: Effect, valid: Tensor) -> None:
        """Take in n transitions per mission.

        Args:
            told: c, as it was when the effect was measured, ``(l, 1, D)``.
            effect: ``(l, n, ...)``.
            valid: which transitions count, ``(l, n)``.
        """
        memory: Memory = self.memory.parts
        noise = torch.where(valid.unsqueeze(-1), effect.noise, 0.0).sum(1)
        noise = noise / valid.sum(1, keepdim=True).clamp_min(1)
        prior = (OFFSET * noise).square().reciprocal().unsqueeze(1)
        self.prior = where(valid.any(1), prior, self.prior)
        theta, covariance = self._fit()
        across = effect.across / effect.noise.unsqueeze(-2)
        total = effect.rest + (across @ told.unsqueeze(-1)).squeeze(-1)
        miss = (total - (across @ theta.unsqueeze(-1)).squeeze(-1)).abs()
        doubt = (across @ covariance * across).sum(-1)
        doubt = where(memory.active, doubt, torch.zeros_like(doubt))
        surprise, error, usual = (
            part.amax(-1) for part in (miss / (1 + doubt).sqrt(), miss, total.abs())
        )
        gram, moment = across.mT @ across, (across.mT @ total.unsqueeze(-1)).mT
        news = Information(gram.unsqueeze(2), moment)
        seen = pooled(news, surprise, error, usual, torch.ones_like(valid), valid)
        self.memory.keep(advance(memory, seen, self.rules)[0])

    def calibration(self) -> Tensor:
        """Return the c ``(l, D)`` to be believed now."""
        theta, _ = self._fit()
        return where(self.memory.parts.better, theta, torch.zeros_like(theta)).squeeze(1)

    def _fit(self) -> tuple[Tensor, Tensor]:
        memory: Memory = self.memory.parts
        nothing = torch.zeros_like(memory.moment)
        theta, covariance = solve(memory.known, fading(self.prior, memory.age), nothing)
        return where(memory.active, theta, nothing), covariance
