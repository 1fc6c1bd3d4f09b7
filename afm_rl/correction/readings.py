"""Readings: which remembered pairs tell what an action does now.

The newest pairs tell it, unless the ground changes from place to place, or the newest commands were
all alike. Each reading is a model of the belief, by what the network answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.experts import Rows

AGE = 20.0  # steps that separate two pairs as much as one unit of place does
FAR = 1e3  # squared distance beyond all
OLDER = 1e-6  # squared distance that a pair is worth less, times its squared age


class Reading(NamedTuple):
    """One way of reading the memory."""

    kind: str = "newest"
    """Which pairs it reads: the "newest", those "near" in place, or some as "varied" as can be."""
    share: float = 0.5
    """Part of the K rows that is filled."""


READINGS = {
    "recent": Reading(),
    "newest": Reading(share=1 / 6),  # right after a change
    "long": Reading(share=1.0),
    "varied": Reading("varied", share=1.0),  # also when it was at rest of late
    "near": Reading("near"),
    "nearest": Reading("near", share=1 / 6),
    "here": Reading("near", share=1 / 12),  # at the edge of two grounds
}


class Reader(nn.Module):
    """Reads a memory in H ways.

    Args:
        names: of :data:`READINGS`.
        rows: of a reading, K.
        size: number of actions, A.

    >>> u = torch.tensor([[0.1], [0.2], [0.3]])
    >>> pairs = torch.cat([u, 10 * u, 0 * u, torch.ones(3, 1), torch.zeros(3, 1)], -1)
    >>> rows = Reader(["long", "newest"], rows=2, size=1)(pairs, torch.zeros(0))
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
        chosen = [READINGS[name] for name in names]
        self.rows, self.size = rows, size
        self.kinds = tuple(dict.fromkeys(reading.kind for reading in chosen))
        count = torch.tensor([max(1, round(reading.share * rows)) for reading in chosen])
        # What was sound before a change tells nothing about it, but of its place.
        least = [0.0 if reading.kind == "near" else 0.5 for reading in chosen]
        fixed = {
            "source": torch.tensor([self.kinds.index(reading.kind) for reading in chosen]),
            "filled": torch.arange(rows - 1, -1, -1).unsqueeze(-1) < count[:, None, None],
            "least": torch.tensor(least)[:, None, None],
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, pairs: Tensor, place: Tensor) -> Rows:
        """Return the rows of each reading, ``(*B, H, K, A)``.

        Args:
            pairs: the memory, the oldest first: executed, effective, standard deviation, valid, and
                innovation and place, ``(*B, M, D)``.
            place: where the robots are, ``(*B, P)``.
        """
        read = torch.stack([self._read(kind, pairs, place) for kind in self.kinds], -3)
        sizes, tail = [self.size] * 3 + [1], pairs.shape[-1] - 3 * self.size - 1
        u, v, std, valid, _ = read.index_select(-3, self.source).split([*sizes, tail], -1)
        known = ((valid > self.least) & self.filled).to(pairs)
        return Rows(u * known, v * known, std * known, known)

    def _read(self, kind: str, pairs: Tensor, place: Tensor) -> Tensor:
        if kind == "near":
            away = (pairs[..., 3 * self.size + 2 :] - place.unsqueeze(-2)).square().sum(-1)
            # Only a row that counts has a place.
            away = torch.where(pairs[..., 3 * self.size] > 0, away, torch.inf)
            return _nearest(pairs, away, self.rows)
        if kind == "varied":
            return _varied(pairs, self.size, self.rows)
        return pairs[..., -self.rows :, :]


def _nearest(pairs: Tensor, away: Tensor, rows: int) -> Tensor:
    """Return the K pairs ``(*B, K, D)`` nearest to here, the nearest last."""
    age = torch.arange(away.shape[-1] - 1, -1, -1, device=away.device) / AGE
    nearest = (away + age.square()).topk(rows, -1, largest=False).indices.flip(-1)
    return pairs.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, pairs.shape[-1]))


def _varied(pairs: Tensor, size: int, rows: int) -> Tensor:
    """Return the pairs whose commands are farthest from all that came after them.

    Of the pairs since the last change, ``(*B, K, D)``, oldest first; the newest is always among
    them. Where there are fewer, rows are not valid.
    """
    sent, sound = pairs[..., :size], pairs[..., 3 * size] == 1.0
    apart = (sent.unsqueeze(-2) - sent.unsqueeze(-3)).square().sum(-1)
    age = torch.arange(pairs.shape[-2] - 1, -1, -1, device=pairs.device)
    later = (age < age.unsqueeze(-1)) & sound.unsqueeze(-2)
    new = torch.where(later, apart, FAR).amin(-1) - OLDER * age.square()
    worth, chosen = torch.where(sound, new, -torch.inf).topk(rows, -1)
    chosen, order = chosen.sort(-1)
    row = chosen.unsqueeze(-1).expand(*chosen.shape, pairs.shape[-1])
    found = worth.gather(-1, order) > -torch.inf
    return pairs.gather(-2, row) * found.unsqueeze(-1)
