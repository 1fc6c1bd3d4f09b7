"""Which of the latest transitions a fit is made from: outliers, changes, and the way back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

QUICK, CEILING = 0.2, 1e6  # growth of the noise level per step, and its upper bound
NEAR = 1.5  # the nominal model is as good: its innovation is at most so many times the fit's
RECENT, MARGIN, CREDIT = 0.8, 0.7, 3.0  # of the comparison with the nominal model


class Memory(NamedTuple):
    """What is known of l missions, and of the latest K transitions of each."""

    share: Tensor
    """Weight of a transition in the fit, 0 for those that do not count, ``(l, K)``."""
    suspect: Tensor
    """Was it, as the latest one, too far from its prediction? ``(l, K)``."""
    exciting: Tensor
    """Whether it says anything about slopes, ``(l, K)``."""
    level: Tensor
    """Median innovation under the fit, at least 1: the level of the noise, ``(l)``."""
    quiet: Tensor
    """For how many transitions the nominal model has been as good as the fit, ``(l)``."""
    active: Tensor
    """Is there a fit? Otherwise the nominal model holds, ``(l)``."""
    explained: Tensor
    """Did the nominal model explain the last transition? ``(l)``."""
    score: Tensor
    """Mean log ratio of the squared errors of fit and nominal model, ``(l)``."""

    @property
    def age(self) -> Tensor:
        """Number of transitions that count, ``(l)``."""
        return (self.share > 0).sum(-1)

    @property
    def better(self) -> Tensor:
        """Is the fit's squared error half the nominal model's, or less? ``(l)``.

        Judged by the latest transitions that either of them could not explain, each predicted
        before it was learnt from. A fit that explains little better is not used.
        """
        return self.active & (self.score < -MARGIN)


class Rules(NamedTuple):
    """How a :class:`Memory` is kept."""

    window: int = 64
    """Transitions that are kept, K; with n simultaneous ones n times as many."""
    forgetting: float = 0.97
    """Weight of a transition relative to the next one, in (0, 1]."""
    gate: float = 5.0
    """Normalised innovation beyond which a transition is suspect."""
    patience: int = 10
    """Transitions for which the nominal model is as good before the fit is dropped."""
    confirm: bool = True
    """Must the next transition confirm a suspicion? False: a single one is a change."""
    restart: bool = True
    """Is what was learnt before a change dropped? False: it is forgotten slowly."""


class Seen(NamedTuple):
    """The latest transitions of each mission, n simultaneous ones."""

    innovation: Tensor
    """Error of the fit, in standard deviations of its prediction, ``(l, n)``."""
    error: Tensor
    """The same in standard deviations of the model, ``(l, n)``."""
    nominal: Tensor
    """Error of the nominal model, in its standard deviations, ``(l, n)``."""
    exciting: Tensor
    """Whether they say anything about slopes, ``(l, n)``."""
    valid: Tensor
    """Do they count at all? ``(l, n)``."""


class Verdict(NamedTuple):
    """What the latest transition was taken for."""

    suspect: Tensor
    """Too far from its prediction, ``(l)``."""
    began: Tensor
    """The regime changed: what was known before was dropped, ``(l)``."""
    ended: Tensor
    """The nominal dynamics are back: everything was dropped, ``(l)``."""


def empty(missions: int, device: torch.device) -> Memory:
    """Return the memory of missions that have seen nothing, in double precision."""
    count = torch.zeros(missions, device=device, dtype=torch.float64)
    none = torch.zeros(missions, 0, device=device, dtype=torch.bool)
    no, score = count.bool(), count - CREDIT
    return Memory(none.double(), none, none, count + 1, count, no, no, score)


def advance(
    memory: Memory, seen: Seen, rules: Rules, parameters: int, stay: Tensor | None = None
) -> tuple[Memory, Verdict]:
    """Take in the latest transitions: decide what they are, and whether they count.

    * A mission without a fit has none until a suspicion is confirmed.
    * A suspect transition under a fit of more than ``parameters + 1`` ones does not count yet. If
      the next one is not suspect, it was an outlier and never counts. If it is, the regime has
      changed: both count and nothing before them does; or, if the nominal model explains both,
      the fit is dropped.
    * A fit is dropped as well once the nominal model has been as good for ``patience``
      transitions, unless ``stay``, ``(l)``, says that this proves nothing.
    * Innovations are measured by the noise that the fit has had so far, if that is more than the
      model's: a robot of which no transition is as predicted is noisy, it does not change.

    Nothing happens to missions without a valid transition, but for a blank one at the end.
    Transitions that say nothing about slopes are learnt from, but nothing is forgotten for them.

    Returns:
        The memory with n more transitions, K + n; and what was decided.
    """
    innovation, error, nominal = (_middle(part, seen.valid) for part in seen[:3])
    exciting, valid = (seen.exciting & seen.valid).any(-1), seen.valid.any(-1)
    waiting = memory.suspect.any(-1)
    ready = memory.age > parameters + 1
    far = innovation > rules.gate
    suspect = (innovation > rules.gate * memory.level) & (ready | ~memory.active)
    confirmed = suspect & (waiting | (not rules.confirm))
    held = suspect & ~confirmed
    explained = nominal <= rules.gate
    as_good = explained & (nominal <= NEAR * innovation.clamp_min(1.0))
    quiet = torch.where(as_good, memory.quiet + exciting, 0.0)
    long = quiet >= rules.patience
    if stay is not None:
        long = long & ~stay
    back = far & waiting & explained & memory.explained
    ended = memory.active & (back | long) & valid
    began = confirmed & (~memory.active | rules.restart) & ~ended & valid

    learn = (confirmed | (memory.active & ~held)) & ~ended
    keep = torch.where(learn & exciting, rules.forgetting, 1.0).to(memory.level)
    keep = torch.where(began | ended, 0.0, keep)
    proven = memory.suspect & (confirmed & ~ended).unsqueeze(-1)
    waits = torch.where(suspect, held, far & memory.active) & ~ended
    rise = torch.where(innovation > memory.level, QUICK, -QUICK).exp()
    level = torch.where(memory.active & ready, memory.level * rise, memory.level)
    ratio = torch.log((1 + error.square()) / (1 + nominal.square()))
    telling = memory.active & ((error > rules.gate) | ~explained)
    score = torch.where(telling, torch.lerp(ratio, memory.score, RECENT), memory.score)
    after = Memory(
        share=torch.where(proven, 1.0, keep.unsqueeze(-1) * memory.share),
        suspect=torch.zeros_like(memory.suspect),
        exciting=memory.exciting,
        level=torch.where(ended, 1.0, level).clamp(1.0, CEILING),
        quiet=torch.where(ended | began | ~memory.active, 0.0, quiet),
        active=(memory.active | confirmed) & ~ended,
        explained=explained,
        score=torch.where(ended | began, -CREDIT, score),
    )
    after = Memory(*(where(valid, *pair) for pair in zip(after, memory, strict=True)))
    counts = (learn.unsqueeze(-1) & seen.valid).double()
    after = after._replace(
        share=torch.cat([after.share, counts], -1),
        suspect=torch.cat([after.suspect, waits.unsqueeze(-1) & seen.valid], -1),
        exciting=torch.cat([after.exciting, seen.exciting & seen.valid], -1),
    )
    return after, Verdict(far & valid, began, ended)


def latest(memory: Memory, rows: Sequence[Tensor], size: int) -> tuple[Memory, list[Tensor]]:
    """Keep ``size`` transitions of each mission, and their ``rows``, ``(l, K, ...)``.

    Those that do not count go first, of these and of the others those that say nothing about
    slopes, and then the older ones: a robot that stands still forgets nothing.
    """
    rank = 2 * ((memory.share > 0) | memory.suspect) + 1 * memory.exciting
    order = rank.argsort(dim=-1, stable=True)[:, -size:]
    mission = torch.arange(len(order), device=order.device).unsqueeze(-1)
    share, suspect, exciting, *kept = (part[mission, order] for part in (*memory[:3], *rows))
    return memory._replace(share=share, suspect=suspect, exciting=exciting), kept


def where(missions: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return ``new`` for some ``missions`` ``(l)`` and ``old`` for the others, ``(l, ...)``."""
    return torch.where(missions.reshape(-1, *(1,) * (old.dim() - 1)), new, old)


def _middle(part: Tensor, valid: Tensor) -> Tensor:
    """Return the median ``(l)`` of those that are valid, ``(l, n)``; 0 if none is."""
    return torch.where(valid, part, torch.nan).nanmedian(-1).values.nan_to_num(0.0)
