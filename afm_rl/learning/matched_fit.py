"""The matched part of a calibration: what other actions can undo."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.dynamics.hammerstein import PLAIN
from afm_rl.learning.error_decomposition import ErrorParts
from afm_rl.learning.least_squares import LEAST, fading
from afm_rl.learning.regime_memory import (
    CREDIT,
    Memory,
    Rules,
    Seen,
    advance,
    empty,
    latest,
    where,
)
from afm_rl.learning.shape_search import Rows, cost_of, features_of, fit, search
from afm_rl.mission_state import MissionState

EXCITING = 0.05  # half ranges: a smaller action tells nothing about slopes
ENOUGH, SHARE = 8, 0.9  # transitions that a shape needs, and how many of them it must explain
GAIN = 10.0  # by how much it must lower the cost
EXACT, ROUGH = 1e-3, 1.0  # mean squared error of a fit with and without shape that is left alone


class Shapes(NamedTuple):
    """The shapes in use."""

    shape: Tensor
    """``(l, 3)``."""
    steps: Tensor
    """Transitions so far, ``(l)``."""


class MatchedFit(nn.Module):
    """D, b and a shape per mission, from effective actions.

    Args:
        prior: information of the prior of D and b side by side, around identity, ``(A, A + 1)``.
        rules: of the memory.
        shapes: whether to search shapes.
    """

    prior: Tensor

    def __init__(self, prior: Tensor, rules: Rules, shapes: bool) -> None:
        super().__init__()
        self.rules, self.shapes = rules, shapes
        self.register_buffer("prior", prior, persistent=False)
        parts = self._empty(0)
        self.memory, self.rows, self.shape = (MissionState(part) for part in parts)

    def clear(self, missions: int) -> None:
        """Forget everything."""
        parts = self._empty(missions)
        for state, part in zip((self.memory, self.rows, self.shape), parts, strict=True):
            state.keep(part)

    def learn(self, action: Tensor, parts: ErrorParts, valid: Tensor) -> None:
        """Take in n transitions per mission.

        Args:
            action: u, ``(l, n, A)``.
            parts: of their errors, ``(l, n, ...)``.
            valid: which of them count, ``(l, n)``.
        """
        memory, each = self.memory.parts, valid.shape[1]
        theta, covariance = self._fit()
        shape, steps = self.shape.parts
        features = features_of(action, shape.unsqueeze(1))
        variance = torch.einsum("lnr,lgrk,lnk->lng", features, covariance, features)
        variance = where(memory.active, variance, torch.zeros_like(variance))
        error = (parts.effective - features @ theta.mT).square() * parts.weight
        nominal = (parts.effective - action).square() * parts.weight
        squares = error / (1 + parts.weight * variance), error, nominal
        innovation, error, nominal = (part.amax(-1).sqrt() for part in squares)
        exciting = (action.abs() > EXCITING).any(-1)
        seen = Seen(innovation, error, nominal, exciting, valid)
        memory, verdict = advance(memory, seen, self.rules, len(self.prior) + 1, self._shaped)
        fresh = action, parts.effective, parts.weight * valid.unsqueeze(-1)
        rows = [torch.cat(pair, 1) for pair in zip(self.rows.parts, fresh, strict=True)]
        memory, rows = latest(memory, rows, self.rules.window * each)
        self.memory.keep(memory)
        self.rows.keep(Rows(*rows))
        lost = (verdict.began & self._shaped) | verdict.ended
        shape = where(lost, torch.tensor(PLAIN).to(shape).expand_as(shape), shape)
        self.shape.keep(Shapes(shape, steps + valid.any(1)))
        if self.shapes:
            self._look(verdict.suspect, each)

    def calibration(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return D ``(l, A, A)``, b ``(l, A)`` and the shape ``(l, 3)`` to use now."""
        theta, _ = self._fit()
        better, shape = self.memory.parts.better, self.shape.parts.shape
        theta = where(better, theta, torch.eye(*self.prior.shape).to(theta).expand_as(theta))
        shape = where(better, shape, torch.tensor(PLAIN).to(shape).expand_as(shape))
        return theta[..., :-1], theta[..., -1], shape

    def _empty(self, missions: int) -> tuple[Memory, Rows, Shapes]:
        memory = empty(missions, self.prior.device)
        row = memory.level.new_zeros(missions, 0, len(self.prior))
        shape = memory.level.new_tensor(PLAIN).repeat(missions, 1)
        return memory, Rows(row, row, row), Shapes(shape, torch.zeros_like(memory.quiet).long())

    @property
    def _shaped(self) -> Tensor:
        """Which missions have a shape, ``(l)``."""
        shape = self.shape.parts.shape
        return (shape != torch.tensor(PLAIN).to(shape)).any(-1)

    def _fit(self) -> tuple[Tensor, Tensor]:
        """Return mean and covariance of D and b side by side, ``(l, A, A + 1)``."""
        memory, prior = self.memory.parts, self.prior.double()
        rows = _weighted(self.rows.parts, memory.share)
        return fit(rows, self.shape.parts.shape, fading(prior, memory.age))

    def _look(self, suspect: Tensor, each: int) -> None:
        """Look for a shape where the fit leaves something, and take it if it is clearly better.

        Under a shape, among the transitions that count. Without one, a regime with a shape is a
        row of changes: then among the latest 8, 16, 32 ..., the more the more seldom.
        """
        memory, cap, shaped = self.memory.parts, self.rules.gate, self._shaped
        shape, steps = self.shape.parts
        size = memory.share.shape[1]
        back = torch.arange(size, 0, -1, device=steps.device) - 1
        last = ENOUGH * (steps & -steps).unsqueeze(-1) * each  # 8 times the power of 2 in steps
        share = self.rules.forgetting ** (back // each) * (back < last)
        share = where(shaped, memory.share, share.to(memory.share))
        rows = _weighted(self.rows.parts, share)
        told = (rows.weight > 0).any(-1).sum(-1)
        cost = cost_of(rows, shape, self._fit()[0], cap)
        left = cost > torch.where(shaped, EXACT, ROUGH) * told
        due = memory.active & (suspect | (shaped & (memory.age < size)))
        index = (due & left & (told >= ENOUGH)).nonzero().squeeze(-1)
        if not len(index):
            return
        found = search(Rows(*(part[index] for part in rows)), self.prior.double() * LEAST, cap)
        good = found.cost < cost[index] - torch.where(shaped[index], 0.0, GAIN)
        good &= found.cost < found.plain - GAIN
        good &= found.cost <= (1 - SHARE) * cap**2 * told[index]
        chosen = torch.zeros_like(shaped).index_fill(0, index[good], True)
        first = chosen & ~shaped
        self.memory.keep(
            memory._replace(
                share=where(first, share * (rows.weight > 0).any(-1), memory.share),
                suspect=memory.suspect & ~first.unsqueeze(-1),
                score=torch.where(first, -CREDIT, memory.score),
                level=torch.where(first, 1.0, memory.level),
                quiet=torch.where(first, 0.0, memory.quiet),
            )
        )
        shape = where(chosen, shape.index_copy(0, index, found.shape), shape)
        self.shape.keep(Shapes(shape, steps))


def _weighted(rows: Rows, share: Tensor) -> Rows:
    return rows._replace(weight=rows.weight * share.unsqueeze(-1))
