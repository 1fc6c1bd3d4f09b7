"""A regime as pairs of executed and effective action."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_count
from afm_rl.flow.base import Context, Corrector, Window
from afm_rl.flow.effective import effective_action

LIMIT = 4.0  # effective actions beyond 4 half ranges are clamped: they carry no more news


class PairCorrector(Corrector):
    """A corrector whose context is K pairs (executed, effective action), in half ranges.

    The model counts as misaligned while the largest surprise in the window exceeds ``gate``
    standard deviations of the model's own noise.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        window: transitions in the context, K.
        gate: in standard deviations of the model.
    """

    def __init__(self, action_low: Tensor, action_high: Tensor, window: int, gate: float) -> None:
        super().__init__(action_low, action_high, gate, check_count("flow.window", window))

    @property
    def feature_size(self) -> int:
        """K (executed, effective, valid)."""
        return self.window * (2 * self.action_size + 1)

    def features(self, executed: Tensor, effective: Tensor, valid: Tensor) -> Tensor:
        """Return the context features ``(*B, C)`` of pairs ``(*B, K, A)``, ``(*B, K)``."""
        pairs = torch.cat([self.normalise(executed), self.normalise(effective)], -1)
        kept = torch.where(valid.unsqueeze(-1), pairs.clamp(-LIMIT, LIMIT), 0.0)
        return torch.cat([kept, valid.unsqueeze(-1).to(kept)], -1).flatten(-2)

    def pairs(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take features apart: executed and effective ``(*B, K, A)``, valid ``(*B, K, 1)``."""
        rows = features.unflatten(-1, (self.window, -1))
        executed, effective, valid = rows.split([self.action_size, self.action_size, 1], -1)
        return executed, effective, valid

    def describe(
        self,
        model: DynamicsModel,
        state: Tensor,
        executed: Tensor,
        next_state: Tensor,
        valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return features ``(*B, C)`` and surprise ``(*B)`` of K transitions ``(*B, K, ...)``."""
        seen = effective_action(model, state, executed, next_state, self.half_range)
        valid = valid & seen.effective.isfinite().all(-1) & seen.surprise.isfinite()
        surprise = torch.where(valid, seen.surprise, 0.0).amax(-1)
        return self.features(executed, seen.effective, valid), surprise

    def context(self, window: Window, model: DynamicsModel, last: Context) -> Context:
        """Describe the window under the present model."""
        rows = window.state, window.executed, window.next_state, window.valid
        features, surprise = self.describe(model, *rows)
        return Context(features, surprise, surprise > self.gate)
