"""Which remembered pairs tell what an action is worth now: the competing views of a context flow.

A window tells the present by its newest pairs, unless commands act late, the ground changes from
place to place, or effects are noisy. Each view reads the memory another way, so that one network
serves them all, and what they would have predicted decides which of them is believed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_choice

SILENT = "silent"  # the hypothesis that actions are worth what they are


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
    SILENT: View(doubt=0.02),  # what it shows is not used
    "recent": View(),
    "newest": View(share=1 / 6, doubt=0.02),  # right after a change
    "long": View(share=1.0),
    "mean": View(share=1.0, merge=2, doubt=0.02),
    "late_1": View(late=1, doubt=0.05),
    "late_2": View(late=2, doubt=0.05),
    "near": View(near=True, doubt=0.03),
    "nearest": View(share=1 / 6, near=True),  # where ground changes, place tells more than time
    "here": View(share=1 / 12, near=True, doubt=0.01),  # at the very edge
}


class Layout(NamedTuple):
    """Which pairs fill the K rows of V views: their ages, the newest being 0.

    A row is the mean of G pairs; views that average fewer repeat them.
    """

    command: Tensor
    """Ages of the commands, ``(*B, V, K, G)``."""
    effect: Tensor
    """Ages of the effects, ``(*B, V, K, G)``."""
    filled: Tensor
    """Which rows are filled, ``(*B, V, K, 1)``, 0 or 1."""
    near: Tensor
    """Does nearness take the place of age? ``(*B, V, 1, 1)``."""


def lay_out(views: Sequence[View], rows: int) -> Layout:
    """Return the layout of K ``rows``.

    >>> lay_out([View(share=1.0, late=1)], rows=3).command.flatten()
    tensor([3, 2, 1])
    """
    group = math.lcm(*(view.merge for view in views))
    row, member = torch.arange(rows - 1, -1, -1), torch.arange(group - 1, -1, -1)
    effect = torch.stack(
        [row.unsqueeze(-1) * view.merge + member * view.merge // group for view in views]
    )
    late = torch.tensor([view.late for view in views])
    count = torch.tensor([max(1, round(view.share * rows)) for view in views])
    return Layout(
        effect + late[:, None, None],
        effect,
        (row < count.unsqueeze(-1)).unsqueeze(-1).float(),
        torch.tensor([view.near for view in views])[:, None, None],
    )


def memory_of(views: Sequence[View], rows: int) -> int:
    """Return how many pairs the views of K ``rows`` read at most."""
    return max(max(rows * view.merge, rows + view.late) for view in views)


def check_views(names: Sequence[str], by_place: bool) -> list[str]:
    """Return the names of the views, without those by place if places are not known.

    Raises:
        ConfigurationError: if it is no list of views, or nothing but silence is left.

    >>> check_views(["silent", "recent", "near"], by_place=False)
    ['silent', 'recent']
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise ConfigurationError(
            f"corrector.views={names!r}: expected a list of {', '.join(VIEWS)}"
        )
    for name in names:
        check_choice("corrector.views", name, VIEWS)
    kept = [name for name in names if by_place or not VIEWS[name].near]
    if not set(kept) - {SILENT}:
        raise ConfigurationError(
            f"corrector.views={list(names)!r}: expected one beside {SILENT}, and robot.place for "
            "views by place"
        )
    return kept
