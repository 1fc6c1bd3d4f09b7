"""Which remembered pairs tell what an action is worth now: the competing views of a context flow.

A window tells the present by its newest pairs, unless commands act late, the ground changes from
place to place, or effects are noisy. Each view reads the memory another way, so that one network
serves them all, and what they would have predicted decides which of them is believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

AGE = 20.0  # steps that part two pairs as much as one unit of place does


class View(NamedTuple):
    """One way of reading a memory of pairs."""

    share: float = 0.5
    """Part of the K rows that is filled; the rest is left blank."""
    late: int = 0
    """Steps from a command to its effect."""
    merge: int = 1
    """Successive pairs that are averaged into one row."""
    near: bool = False
    """Read the pairs nearest in place, not in time?"""
    doubt: float = 0.0
    """How much worse than the first view it must be expected to do."""


VIEWS = {
    "recent": View(),
    "newest": View(share=1 / 6, doubt=0.02),  # right after a change
    "long": View(share=1.0),
    "mean": View(share=1.0, merge=2, doubt=0.02),
    "late_1": View(late=1, doubt=0.05),
    "late_2": View(late=2, doubt=0.05),
    "near": View(near=True, doubt=0.05),
    "nearest": View(share=1 / 6, near=True, doubt=0.05),
}


class Pairs(NamedTuple):
    """Remembered pairs, oldest first."""

    executed: Tensor
    """Executed actions in half ranges, ``(*B, M, A)``."""
    effective: Tensor
    """What they were worth, ``(*B, M, A)``."""
    valid: Tensor
    """Which count, ``(*B, M, 1)``, 0 or 1."""

    def rows(self, first: int, last: int) -> Pairs:
        """Return the pairs from ``first`` on and before ``last``."""
        return Pairs(*(part[..., first:last, :] for part in self))


def memory_of(views: Sequence[View], rows: int) -> int:
    """Return how many pairs the views of K ``rows`` read at most, one step back."""
    return 1 + max(max(rows * view.merge, rows + view.late) for view in views)


def look(pairs: Pairs, views: Sequence[View], rows: int, away: Tensor | None = None) -> Tensor:
    """Return what each view shows, as features ``(*B, V, K (2 A + 1))``.

    Args:
        pairs: the memory.
        views: V ways of reading it.
        rows: K.
        away: squared distance in place of each pair from here, ``(*B, M)``.

    >>> u = torch.tensor([[0.1], [0.2], [0.3]])
    >>> pairs = Pairs(u, 10 * u, torch.ones(3, 1))
    >>> look(pairs, [View(share=1.0), View(share=1.0, late=1)], rows=2)
    tensor([[0.2000, 2.0000, 1.0000, 0.3000, 3.0000, 1.0000],
            [0.1000, 2.0000, 1.0000, 0.2000, 3.0000, 1.0000]])
    """
    shown = []
    for view in views:
        seen = _nearest(pairs, away, rows) if view.near else _newest(pairs, view, rows)
        known = seen.valid.clone()
        known[..., : rows - max(1, round(view.share * rows)), :] = 0.0
        shown.append(torch.cat([seen.executed, seen.effective, torch.ones_like(known)], -1) * known)
    return torch.stack(shown, -3).flatten(-2)


def _newest(pairs: Pairs, view: View, rows: int) -> Pairs:
    end = pairs.valid.shape[-2]
    seen = pairs.rows(end - rows * view.merge, end)
    if view.late:
        earlier = pairs.rows(end - rows - view.late, end - view.late)
        both = earlier.valid * seen.valid
        return Pairs(earlier.executed, seen.effective, both)
    if view.merge > 1:
        seen = Pairs(*(part.unflatten(-2, (rows, view.merge)).mean(-2) for part in seen))
        return seen._replace(valid=(seen.valid == 1.0).to(seen.valid))
    return seen


def _nearest(pairs: Pairs, away: Tensor | None, rows: int) -> Pairs:
    """Return the pairs nearest to here, the nearest last."""
    if away is None:
        raise ValueError("views: a view by place needs distances")
    count = pairs.valid.shape[-2]
    age = torch.arange(count - 1, -1, -1, device=away.device) / AGE
    apart = torch.where(pairs.valid.squeeze(-1) == 1.0, away + age.square(), torch.inf)
    chosen = apart.topk(rows, -1, largest=False).indices.flip(-1).unsqueeze(-1)

    def pick(part: Tensor) -> Tensor:
        return part.gather(-2, chosen.expand(*chosen.shape[:-1], part.shape[-1]))

    return Pairs(*(pick(part) for part in pairs))


class Memory(NamedTuple):
    """What N robots remember, and how far from it they are."""

    pairs: Pairs
    """The pairs, ``(N, M, ...)``."""
    away_before: Tensor
    """Squared distance in place of each pair from where the robot was a step ago, ``(N, M)``."""
    away: Tensor
    """From where it is now."""

    def before(self, views: Sequence[View], rows: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what each view showed a step ago, and what it should have foreseen.

        Features ``(N, V, K (2 A + 1))``, the actions that were about to act ``(N, V, A)`` and the
        effect that there was ``(N, 1, A)``.
        """
        newest = self.pairs.valid.shape[-2] - 1
        shown = look(self.pairs.rows(0, newest), views, rows, self.away_before[:, :-1])
        acted = self.pairs.executed[:, [newest - view.late for view in views]]
        return shown, acted, self.pairs.effective[:, -1:]

    def now(self, views: Sequence[View], chosen: Tensor, rows: int) -> Tensor:
        """Return what the ``chosen`` views ``(N,)`` show now, features ``(N, K (2 A + 1))``."""
        executed = self.pairs.executed
        features = executed.new_empty(len(chosen), rows * (2 * executed.shape[-1] + 1))
        for k in chosen.unique().tolist():
            who = chosen == k
            pairs = Pairs(*(part[who] for part in self.pairs))
            features[who] = look(pairs, [views[k]], rows, self.away[who]).squeeze(-2)
        return features
