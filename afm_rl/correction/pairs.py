"""Transitions as pairs of executed and effective action."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.correction.achievable import LIMIT
from afm_rl.correction.base import Corrector, Fields
from afm_rl.correction.least_squares import fit_gain
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action


class PairCorrector(Corrector):
    """A corrector that remembers pairs (executed, effective), shares of the largest action.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        recent: newest transitions, R: a model that learns measures them again at every step.
        memory: pairs that are remembered.
        gate: innovation, in standard deviations that the model states, up to which a transition
            needs no explanation.
        delay: steps from an action to its effect that are known, see
            :class:`~afm_rl.correction.Corrector`.
        home: the neutral action, likewise.
    """

    is_valid: Tensor
    is_command: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        recent: int,
        memory: int,
        gate: float = 1.0,
        delay: int | Sequence[int] = 0,
        home: Sequence[float] | None = None,
    ) -> None:
        super().__init__(action_low, action_high, recent, delay, home)
        self.memory, self.gate = max(memory, recent), gate
        self.pair_size = 3 * self.action_size + 2
        is_valid = torch.arange(self.pair_size) == 3 * self.action_size
        self.register_buffer("is_valid", is_valid, persistent=False)
        is_command = torch.arange(self.pair_size) < self.action_size
        self.register_buffer("is_command", is_command, persistent=False)

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the pairs: u, its effect, std, valid, innovation."""
        return {
            **super().shapes(state_size),
            "pairs": (self.memory, self.pair_size),
            "acting": (self.action_size,),
        }

    def measure(self, fields: Fields, model: DynamicsModel) -> Tensor:
        """Return the newest N pairs ``(*B, N, D)``: executed actions and their effects by a model.

        A model that does not learn measures only the newest transition; a model that learns
        measures all R again.
        """
        count, size = fields["valid"].shape[-2], self.action_size
        count = 1 if model.taught_in is None else count
        names = ("states", "actions", "next_states", "valid")
        state, executed, reached, valid = (fields[name][..., -count:, :] for name in names)
        # What acted last was predicted to have an effect; older ones were measured before.
        before = fields["pairs"][..., self.memory - count + 1 :, size : 2 * size]
        guess = self.denormalise(torch.cat([before, fields["acting"].unsqueeze(-2)], -2))
        quiet = torch.where(fields["corrected"] == 1.0, 0.0, self.gate)
        seen = effective_action(
            model, state, executed, reached, self.scale, quiet=quiet, guess=guess
        )
        effect, std = self.normalise(seen.action), seen.std
        innovation = seen.innovation.unsqueeze(-1)
        return torch.cat([self.normalise(executed), effect, std, valid, innovation], -1)

    def remember(self, before: Tensor, pairs: Tensor) -> Tensor:
        """Return pairs ``(*B, M, D)`` with the newest N ``(*B, N, D)``, as they were measured."""
        count, size = pairs.shape[-2], self.action_size
        sent, effect, std, valid, innovation = pairs.split([size, size, size, 1, 1], -1)
        limited = [sent, effect.clamp(-LIMIT, LIMIT), std.clamp_max(LIMIT), valid, innovation]
        pairs = torch.cat(limited, -1)
        sound = (valid == 1.0) & pairs.isfinite().all(-1, keepdim=True)
        older, asked = before[..., 1:, :].split([self.memory - count, count - 1], -2)
        pairs = torch.where(sound | self.is_command, pairs, 0.0)  # what was sent is known
        if count > 1:  # those that were marked as old stay so
            old = torch.nn.functional.pad(asked == 0.5, (0, 0, 0, 1)) & self.is_valid
            pairs = torch.where(old, 0.5 * pairs, pairs)
        return torch.cat([older, pairs], -2)

    def cause_in(self, memory: Fields) -> str:
        """Return the gains that explain the pairs of memories ``(*B)``, in words, if any do."""
        pairs = memory["pairs"].flatten(0, -2)
        sent, came, std, valid, _ = pairs.split([*[self.action_size] * 3, 1, 1], -1)
        return gains_in_words(sent, came, std, valid)

    def mark_old(self, pairs: Tensor, begins: Tensor) -> Tensor:
        """Return pairs ``(*B, M, D)`` with all but the newest marked as old.

        "valid" is halved: a change has begun since.

        Args:
            pairs: the oldest first.
            begins: does a change begin? ``(*B, 1)``.
        """
        is_old = torch.arange(self.memory, device=pairs.device) < self.memory - 1
        old = self.is_valid & is_old.unsqueeze(-1) & begins.unsqueeze(-1)
        return torch.where(old, 0.5 * pairs, pairs)


def gains_in_words(sent: Tensor, came: Tensor, std: Tensor, valid: Tensor) -> str:
    """Return the gains that explain pairs in words; nothing if they explain less than half.

    Args:
        sent: commands, ``(K, A)``.
        came: effective actions.
        std: standard deviations of these.
        valid: how much pairs count, ``(K, 1)``.

    >>> u = torch.tensor([[0.5], [-1.0], [0.2]])
    >>> gains_in_words(u, -2 * u, 0 * u, torch.ones(3, 1))
    'gain -2 on all: a sign of the model?'
    """
    sent, came, std, valid = (of.double() for of in (sent, came, std, valid))
    weight = valid / (std.square() + 0.05**2)
    gains = fit_gain(sent, came, weight)
    left = (weight * (came - gains * sent).square()).sum() / (weight * came.square()).sum()
    if not bool(left < 0.5):  # nor where nothing moved
        return ""
    alike = bool((gains - gains.mean()).abs().amax() < 0.1 * gains.mean().abs())
    values = [f"{gain:.2g}" for gain in (gains[:1] if alike else gains[:8]).tolist()]
    more = " on all" if alike else ", ..." if len(gains) > 8 else ""
    reason = "a sign" if bool((gains < 0).any()) else "dt or a unit"
    return f"gain {', '.join(values)}{more}: {reason} of the model?"
