"""Context windows: the remembered pairs that the network is given, in several ways.

The newest pairs show what an action does now, unless the ground changes from place to place, or
the newest commands were all alike. Each context window is a model of the belief.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.experts import Rows


class ContextWindow(NamedTuple):
    """Pairs that the network is given."""

    kind: str = "newest"
    """Which pairs: the "newest", those "near" in place, or some as "varied" as can be."""
    share: float = 0.5
    """Part of the K rows that is filled."""
    usual: bool = True
    """Is it among the hypotheses if none are named?"""


CONTEXT_WINDOWS = {
    "recent": ContextWindow(),
    "newest": ContextWindow(share=1 / 6, usual=False),  # where older pairs are soon wrong
    "varied": ContextWindow("varied", share=1.0),  # also when it was at rest of late
    "near": ContextWindow("near"),
    "nearest": ContextWindow("near", share=1 / 6),
    "here": ContextWindow("near", share=1 / 12),  # at the edge of two grounds
}


class ContextWindows(nn.Module):
    """H context windows of a memory.

    Args:
        names: of :data:`CONTEXT_WINDOWS`.
        rows: of a window, K.
        size: number of actions, A.

    >>> u = torch.tensor([[0.1], [0.2], [0.3]])
    >>> pairs = torch.cat([u, 10 * u, 0 * u, torch.ones(3, 1), torch.zeros(3, 1)], -1)
    >>> rows = ContextWindows(["varied", "newest"], rows=2, size=1)(pairs)
    >>> rows.executed.squeeze(-1), rows.valid.squeeze(-1)
    (tensor([[0.2000, 0.3000],
            [0.0000, 0.3000]]), tensor([[1., 1.],
            [0., 1.]]))
    """

    source: Tensor
    filled: Tensor
    least: Tensor

    def __init__(self, names: Sequence[str], rows: int, size: int) -> None:
        super().__init__()
        windows = [CONTEXT_WINDOWS[name] for name in names]
        self.rows, self.size = rows, size
        self.kinds = tuple(dict.fromkeys(window.kind for window in windows))
        count = torch.tensor([max(1, round(window.share * rows)) for window in windows])
        # What was sound before a change tells nothing about it, but of its place.
        least = [0.0 if window.kind == "near" else 0.5 for window in windows]
        fixed = {
            "source": torch.tensor([self.kinds.index(window.kind) for window in windows]),
            "filled": torch.arange(rows - 1, -1, -1).unsqueeze(-1) < count[:, None, None],
            "least": torch.tensor(least)[:, None, None],
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, pairs: Tensor, place: Tensor | None = None) -> Rows:
        """Return the rows of each window, ``(*B, H, K, A)``.

        Args:
            pairs: the memory, the oldest first: executed, effective, standard deviation, valid, and
                innovation and place, ``(*B, M, D)``.
            place: where the robots are, ``(*B, G)``; None: no window asks for it.
        """
        rows = torch.stack([self._select(kind, pairs, place) for kind in self.kinds], -3)
        sizes, tail = [self.size] * 3 + [1], pairs.shape[-1] - 3 * self.size - 1
        u, v, std, valid, _ = rows.index_select(-3, self.source).split([*sizes, tail], -1)
        known = ((valid > self.least) & self.filled).to(pairs)
        return Rows(u * known, v * known, std * known, known)

    def _select(self, kind: str, pairs: Tensor, place: Tensor | None) -> Tensor:
        if kind == "near" and place is not None:
            away = (pairs[..., 3 * self.size + 2 :] - place.unsqueeze(-2)).square().sum(-1)
            # Only a row that counts has a place.
            away = torch.where(pairs[..., 3 * self.size] > 0, away, torch.inf)
            return _nearest(pairs, away, self.rows)
        if kind == "varied":
            return _varied(pairs, self.size, self.rows)
        return pairs[..., -self.rows :, :]


def _nearest(pairs: Tensor, away: Tensor, rows: int) -> Tensor:
    """Return the K pairs ``(*B, K, D)`` nearest to here, the nearest last."""
    # Twenty steps separate two pairs as much as one unit of place does.
    age = torch.arange(away.shape[-1] - 1, -1, -1, device=away.device) / 20
    nearest = (away + age.square()).topk(rows, -1, largest=False).indices.flip(-1)
    return pairs.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, pairs.shape[-1]))


def _varied(pairs: Tensor, size: int, rows: int) -> Tensor:
    """Return the pairs whose commands are farthest from all that came after them.

    Of the pairs since the last change, ``(*B, K, D)``, oldest first; the newest is always among
    them. Where there are fewer, rows are not valid.
    """
    sent, sound = pairs[..., :size], pairs[..., 3 * size] == 1.0
    by_axis = sent.mT  # rows last: loops over two or three numbers are slow
    apart = (by_axis.unsqueeze(-1) - by_axis.unsqueeze(-2)).square().sum(-3)
    age = torch.arange(pairs.shape[-2] - 1, -1, -1, device=pairs.device)
    later = (age < age.unsqueeze(-1)) & sound.unsqueeze(-2)
    # The squared distance to what came later (1e3: nothing did); of equal ones, the newer.
    novelty = torch.where(later, apart, 1e3).amin(-1) - 1e-6 * age.square()
    novelty, chosen = torch.where(sound, novelty, -torch.inf).topk(rows, -1)
    chosen, order = chosen.sort(-1)
    row = chosen.unsqueeze(-1).expand(*chosen.shape, pairs.shape[-1])
    is_pair = novelty.gather(-1, order) > -torch.inf
    return pairs.gather(-2, row) * is_pair.unsqueeze(-1)
