"""What classical correctors share: one fit to all that is remembered, beside doing nothing."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from afm_rl.correction.base import Fields
from afm_rl.correction.experts import Rows
from afm_rl.correction.pairs import Answer, PairCorrector


class ClassicalCorrector(PairCorrector):
    """A corrector with one model, a fit to all pairs that it remembers.

    On each axis its answer is executed while the fit is believed more than *nothing has changed*.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        window: transitions that are remembered, K.
        rules: of the belief, see :class:`~afm_rl.correction.PairCorrector`.
    """

    def __init__(
        self, action_low: Tensor, action_high: Tensor, window: int, **rules: float
    ) -> None:
        super().__init__(action_low, action_high, window, window, ["fit"], **rules)

    def rows(self, parts: Fields) -> Rows:
        """Return what is remembered as rows."""
        size = self.action_size
        sizes = [size, size, size, 1, self.pair_size - 3 * size - 1]
        executed, effective, std, valid, _ = parts["pairs"].split(sizes, -1)
        return Rows(executed, effective, std, (valid > 0).to(executed))

    def answer(self, parts: Fields, planned: Tensor, box: Tensor) -> Answer:
        """Execute the fit's inverse where it is believed."""
        weights = self.belief(parts).weights(self.prior.to(planned))
        corrects = weights[..., 1, :] > weights[..., 0, :]
        unit = self.normalise(planned)
        found = torch.where(corrects, self.inverse(self.rows(parts), unit), unit)
        forecasts, late = self.foresee(parts, self.denormalise(found))
        predicted = torch.where(corrects, forecasts[..., 1, :], unit)
        return Answer(
            self.denormalise(found),
            self.denormalise(predicted),
            torch.zeros_like(planned),
            box,
            corrects.any(-1),
            forecasts,
            late,
        )

    def foresee(self, parts: Fields, executed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the effects by both models; nothing is late."""
        unit = self.normalise(executed)
        forecasts = torch.stack([unit, self.effect(self.rows(parts), unit)], -2)
        return forecasts, parts["under_way"]

    @abstractmethod
    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for a plan, both in u."""

    @abstractmethod
    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Return the effect ``(*B, A)`` of an action, both in u."""
