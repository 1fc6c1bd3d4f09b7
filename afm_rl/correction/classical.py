"""What classical correctors share: one fit to all that is remembered, which always acts."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold
from afm_rl.correction.base import Correction, Fields, put, rows_of
from afm_rl.correction.experts import Rows
from afm_rl.correction.pairs import PairCorrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_number


class ClassicalCorrector(PairCorrector):
    """A corrector that answers a plan from all pairs that it remembers, as the textbooks do.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        gate: largest innovation of the remembered transitions at which it does nothing, in
            standard deviations that the model states.
        window: transitions that are remembered, K.
    """

    def __init__(self, action_low: Tensor, action_high: Tensor, gate: float, window: int) -> None:
        quiet = check_number("corrector.gate", gate, low=0.0)
        super().__init__(action_low, action_high, window, window, quiet=quiet)

    def rows(self, parts: Fields) -> Rows:
        """Return what is remembered as rows."""
        size = self.action_size
        sizes = [size, size, size, 1, self.tail]
        executed, effective, std, valid, _ = parts["pairs"].split(sizes, -1)
        return Rows(executed, effective, std, (valid > 0).to(executed))

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Answer where the model is contradicted."""
        parts = self._watched(memory, model)
        innovation, misaligned = self._innovation(parts)
        found = self.unchanged(planned, innovation, box)
        if not all_hold(~misaligned):
            use = rows_of(misaligned)
            rows = self.rows({"pairs": parts["pairs"][use]})
            unit = self.inverse(rows, self.normalise(planned[use]))
            executed, predicted = (
                put(planned, misaligned, use, self.denormalise(part))
                for part in (unit, self.effect(rows, unit))
            )
            found = found._replace(executed=executed, predicted=predicted, misaligned=misaligned)
        parts |= {"planned": planned, "executed": found.executed, "acting": found.predicted}
        parts["misaligned"] = misaligned.unsqueeze(-1).to(planned.dtype)
        return self.pack(parts), found

    def predict(
        self, memory: Tensor, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        """Return the effect that an action will have by the fit, and how far that was off."""
        parts = self._watched(memory, model)
        rows, unit = self.rows(parts), self.normalise(action)
        misaligned = self._innovation(parts)[1].unsqueeze(-1)
        fitted = torch.stack([self.effect(rows, u) for u in rows.executed.unbind(-2)], -2)
        miss = (rows.effective - fitted).square() * rows.valid
        std = (miss.sum(-2) / rows.valid.sum(-2).clamp_min(1.0)).sqrt()
        mean = torch.where(misaligned, self.effect(rows, unit), unit)
        return self.denormalise(mean), self.denormalise(std)

    def _watched(self, memory: Tensor, model: DynamicsModel) -> Fields:
        """Return the parts with the newest pairs, older ones marked where a change begins."""
        parts = self.look(memory, model)
        count = 1 if model.taught_in is None else self.recent
        surprise = parts["pairs"][..., -1:, -self.tail] > self.quiet
        begins = (parts["misaligned"] != 1.0) & surprise
        return parts | {"pairs": self.aged(parts["pairs"], begins, count)}

    def _innovation(self, parts: Fields) -> tuple[Tensor, Tensor]:
        innovation = parts["pairs"][..., -self.recent :, -self.tail].amax(-1)
        return innovation, innovation > self.quiet

    @abstractmethod
    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for a plan, both in u."""

    @abstractmethod
    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Return the effect ``(*B, A)`` of an action, both in u."""
