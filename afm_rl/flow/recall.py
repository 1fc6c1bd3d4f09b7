"""What a robot remembers, as each view shows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.flow.views import Layout

AGE = 20.0  # steps that part two pairs as much as one unit of place does


class Pairs(NamedTuple):
    """Remembered pairs, oldest first."""

    executed: Tensor
    """Executed actions in half ranges, ``(*B, M, A)``."""
    effective: Tensor
    """What they were worth, ``(*B, M, A)``."""
    valid: Tensor
    """Which count, ``(*B, M, 1)``, 0 or 1."""


def look(pairs: Pairs, layout: Layout, away: Tensor | None = None) -> Tensor:
    """Return what each view shows, as features ``(*B, V, K (2 A + 1))``.

    Args:
        pairs: the memory.
        layout: V ways of reading it, see :func:`~afm_rl.flow.views.lay_out`.
        away: squared distance in place of each pair from here, ``(*B, M)``.

    >>> from afm_rl.flow.views import View, lay_out
    >>> u = torch.tensor([[0.1], [0.2], [0.3]])
    >>> pairs = Pairs(u, 10 * u, torch.ones(3, 1))
    >>> look(pairs, lay_out([View(share=1.0), View(share=1.0, late=1)], rows=2))
    tensor([[0.2000, 2.0000, 1.0000, 0.3000, 3.0000, 1.0000],
            [0.1000, 2.0000, 1.0000, 0.2000, 3.0000, 1.0000]])
    """
    newest = pairs.valid.shape[-2] - 1
    command, effect = newest - layout.command, newest - layout.effect
    if bool(layout.near.any()):
        nearest = _nearest(pairs.valid, away, command.shape[-2])[..., None, :, None]
        command = torch.where(layout.near, nearest, command)
        effect = torch.where(layout.near, nearest, effect)
    executed, sent = _pick(pairs.executed, command), _pick(pairs.valid, command)
    effective, came = _pick(pairs.effective, effect), _pick(pairs.valid, effect)
    known = (sent * came).amin(-2) * layout.filled
    means = torch.cat([executed, effective], -1).mean(-2)
    return torch.cat([means * known, known], -1).flatten(-2)


def _pick(part: Tensor, index: Tensor) -> Tensor:
    """Return the pairs ``(*B, V, K, G, D)`` of a part ``(*B, M, D)``."""
    rows = index.expand(*part.shape[:-2], *index.shape[-3:])
    flat = rows.flatten(-3).unsqueeze(-1).expand(*part.shape[:-2], -1, part.shape[-1])
    return part.gather(-2, flat).unflatten(-2, rows.shape[-3:])


def _nearest(valid: Tensor, away: Tensor | None, rows: int) -> Tensor:
    """Return the indices ``(*B, K)`` of the pairs nearest to here, the nearest last."""
    if away is None:
        raise ValueError("views: a view by place needs distances")
    age = torch.arange(valid.shape[-2] - 1, -1, -1, device=away.device) / AGE
    apart = torch.where(valid.squeeze(-1) == 1.0, away + age.square(), torch.inf)
    return apart.topk(rows, -1, largest=False).indices.flip(-1)


class Memory(NamedTuple):
    """What robots remember, and how far from it they are."""

    pairs: Pairs
    """The pairs, ``(*B, M, ...)``."""
    away: Tensor
    """Squared distance in place of each pair from where the robot is now, ``(*B, M)``."""

    def shown(self, layout: Layout) -> Tensor:
        """Return what each view shows, features ``(*B, V, K (2 A + 1))``."""
        return look(self.pairs, layout, self.away)

    def acted(self, layout: Layout) -> Tensor:
        """Return the action that acted last, as each view has it, ``(*B, V, A)``."""
        late = (layout.command - layout.effect)[:, 0, 0]
        return self.pairs.executed[..., self.pairs.valid.shape[-2] - 1 - late, :]


def recall(
    pairs: Tensor, state: Tensor, next_state: Tensor, place: Sequence[int], scale: float
) -> Memory:
    """Return what robots remember.

    Args:
        pairs: executed, effective, valid, surprise, ``(*B, M, 2 A + 2)``, oldest first.
        state: where they acted, ``(*B, M, S)``.
        next_state: where they came to, ``(*B, M, S)``.
        place: coordinates of the state that make a place.
        scale: distance at which one is another.
    """
    size = pairs.shape[-1] // 2 - 1
    seen = Pairs(*pairs[..., :-1].split([size, size, 1], -1))
    apart = (state[..., place] - next_state[..., -1:, place]) / scale
    return Memory(seen, apart.square().sum(-1).nan_to_num(torch.inf))
