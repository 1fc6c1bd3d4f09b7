"""Transitions as pairs of executed and effective action."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold
from afm_rl.correction.base import Correction, Corrector, put, rows_of
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import check_count
from afm_rl.flow.experts import LIMIT, Rows

OLD = 0.5  # what "valid" becomes where a change has begun since


class PairCorrector(Corrector):
    """A corrector that remembers M pairs (executed, effective action), shares of the largest.

    The model counts as misaligned while the largest normalised innovation of the newest
    transitions exceeds ``gate`` standard deviations of the model's own noise. While it is
    aligned, an executed action counts as its own effect, and nothing more is computed. When the
    gate opens, the pairs from before are marked as old: "valid" is halved.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        gate: in standard deviations of the model.
        recent: newest transitions, R: the gate looks at these, and a model that learns is asked
            about them again at every step.
        memory: pairs that are remembered, M.
        place: number of state coordinates that are remembered with a pair.
    """

    is_valid: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        gate: float,
        recent: int,
        memory: int,
        place: int = 0,
    ) -> None:
        super().__init__(action_low, action_high, gate, recent)
        self.memory = max(check_count("corrector.memory", memory), recent)
        self.pair_size, self.tail = 3 * self.action_size + 2 + place, 1 + place
        is_valid = torch.arange(self.pair_size) == 3 * self.action_size
        self.register_buffer("is_valid", is_valid, persistent=False)

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the pairs: u, its effect, std, valid, innovation, place."""
        return {
            **super().shapes(state_size),
            "pairs": (self.memory, self.pair_size),
            "acting": (self.action_size,),
        }

    def place_of(self, state: Tensor) -> Tensor:
        """Return the coordinates of states that are remembered with pairs; none by default."""
        return state[..., :0]

    def look(self, memory: Tensor, model: DynamicsModel) -> tuple[Tensor, Tensor]:
        """Return the memory with the newest transitions as pairs, and the innovation ``(*B)``.

        A model that stays as it is needs to be asked about the newest transition only, one that
        learns about all R.
        """
        parts = self.unpack(memory, model.state_size)
        count = 1 if model.taught_in is None else self.recent
        rows = parts["transitions"][..., -count:, :]
        state, _, executed, reached, valid = self.split_transitions(rows, model.state_size)
        # What acted last was predicted to have an effect; older ones were asked about before.
        before = parts["pairs"][..., self.memory - count + 1 :, self.action_size :]
        guess = self.denormalise(before[..., : self.action_size])
        guess = torch.cat([guess, parts["acting"].unsqueeze(-2)], -2)
        quiet = torch.where(parts["misaligned"] == 1.0, 0.0, self.gate)
        seen = effective_action(
            model, state, executed, reached, self.scale, quiet=quiet, guess=guess
        )
        std = (seen.std / self.scale).clamp_max(LIMIT)
        rows = torch.cat(
            [
                self.normalise(executed),
                self.normalise(seen.action).clamp(-LIMIT, LIMIT),
                std,
                valid,
                seen.innovation.unsqueeze(-1),
                self.place_of(state),
            ],
            -1,
        )
        sound = (valid == 1.0) & rows.isfinite().all(-1, keepdim=True)
        rows = torch.where(sound, rows, 0.0)
        older = parts["pairs"][..., 1 : self.memory - count + 1, :]
        begins = (parts["misaligned"] != 1.0) & (rows[..., -1:, -self.tail] > self.gate)
        older = torch.where(self.is_valid & begins.unsqueeze(-1), OLD * older, older)
        parts["pairs"] = torch.cat([older, rows], -2)
        innovation = parts["pairs"][..., -self.recent :, -self.tail].amax(-1)
        return self.pack(parts), innovation


class ClassicalCorrector(PairCorrector):
    """A corrector that answers a plan from all pairs that it remembers, at once.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        gate: in standard deviations of the model.
        window: transitions that are remembered, K.
    """

    def __init__(self, action_low: Tensor, action_high: Tensor, gate: float, window: int) -> None:
        super().__init__(action_low, action_high, gate, window, window)

    def rows(self, pairs: Tensor) -> Rows:
        """Return pairs as rows."""
        size = self.action_size
        sizes = [size, size, size, 1, self.pair_size - 3 * size - 1]
        executed, effective, std, valid, _ = pairs.split(sizes, -1)
        return Rows(executed, effective, std, (valid > 0).to(pairs))

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Answer where the model is misaligned."""
        memory, innovation = self.look(memory, model)
        parts = self.unpack(memory, model.state_size)
        found = self.unchanged(planned, innovation, box)
        misaligned = innovation > self.gate
        if not all_hold(~misaligned):
            use = rows_of(misaligned)
            rows, unit = self.rows(parts["pairs"][use]), self.normalise(planned[use])
            executed, predicted = (
                put(planned, misaligned, use, self.denormalise(part))
                for part in self.answer(rows, unit)
            )
            found = found._replace(executed=executed, predicted=predicted, misaligned=misaligned)
        parts |= {"planned": planned, "executed": found.executed, "acting": found.predicted}
        parts["misaligned"] = misaligned.unsqueeze(-1).to(planned.dtype)
        return self.pack(parts), found

    @abstractmethod
    def answer(self, rows: Rows, planned: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action to execute for a plan ``(*B, A)`` in u, and its predicted effect."""
