"""A regime as pairs of executed and effective action."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_count
from afm_rl.flow.base import Context, Corrector, Window
from afm_rl.flow.effective import effective_action
from afm_rl.flow.saturation import LIMIT


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
        super().__init__(action_low, action_high, gate, check_count("corrector.window", window))

    @property
    def feature_size(self) -> int:
        """K (executed, effective, valid)."""
        return self.window * (2 * self.action_size + 1)

    @property
    def pair_size(self) -> int:
        """Executed, effective, valid, surprise."""
        return 2 * self.action_size + 2

    def judge(
        self,
        model: DynamicsModel,
        state: Tensor,
        executed: Tensor,
        next_state: Tensor,
        valid: Tensor,
    ) -> Tensor:
        """Return what transitions ``(*B, K, ...)`` mean, ``(*B, K, R)``; zero if not valid."""
        seen = effective_action(model, state, executed, next_state, self.half_range)
        valid = valid & seen.effective.isfinite().all(-1) & seen.surprise.isfinite()
        actions = torch.cat([self.normalise(executed), self.normalise(seen.effective)], -1)
        rest = torch.stack([torch.ones_like(seen.surprise), seen.surprise], -1)
        pairs = torch.cat([actions.clamp(-LIMIT, LIMIT), rest], -1)
        return torch.where(valid.unsqueeze(-1), pairs, 0.0)

    def remember(self, window: Window, model: DynamicsModel, last: Context | None) -> Tensor:
        """Return the pairs ``(*B, M, R)`` of a window under the present model.

        A model that stays as it is needs to be asked about the newest transition only, one that
        learns about the newest :attr:`fresh`.
        """
        count = self.window if last is None else 1 if model.taught_in is None else self.fresh
        rows = window.state, window.executed, window.next_state, window.valid
        newest = (part.narrow(window.valid.dim() - 1, self.window - count, count) for part in rows)
        pairs = self.judge(model, *newest)
        if last is None or count == self.window:
            return pairs
        return torch.cat([last.pairs[..., 1 : self.window - count + 1, :], pairs], -2)

    @property
    def fresh(self) -> int:
        """Number of transitions about which a model that learns is asked anew at each step."""
        return self.window

    def surprise(self, pairs: Tensor) -> Tensor:
        """Return the largest surprise ``(*B)`` of the newest :attr:`fresh` transitions."""
        return pairs[..., -self.fresh :, -1].amax(-1)

    def context(self, window: Window, model: DynamicsModel, last: Context | None = None) -> Context:
        """Describe the window under the present model."""
        pairs = self.remember(window, model, last)
        surprise = self.surprise(pairs)
        evidence = pairs.new_zeros(*surprise.shape, 0)
        return Context(pairs, evidence, pairs[..., :-1].flatten(-2), surprise, surprise > self.gate)

    def pairs(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take features apart: executed and effective ``(*B, K, A)``, valid ``(*B, K, 1)``."""
        size = self.action_size
        rows = features.unflatten(-1, (-1, 2 * size + 1))
        executed, effective, valid = rows.split([size, size, 1], -1)
        return executed, effective, valid
