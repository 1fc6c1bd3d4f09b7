"""What missions know of their regimes: outliers, changes, and the way back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.learning.recursive_least_squares import Information

QUICK, CEILING = 0.2, 1e6  # growth of the noise level per step, and how far it goes
NEAR = 1.5  # the nominal model is as good: its surprise is at most so many times the fit's
RECENT, MARGIN, CREDIT = 0.8, 0.7, 3.0  # of the comparison with the nominal model


class Memory(NamedTuple):
    """What is known about each mission, l of them."""

    gram: Tensor
    """Information of the transitions that count, ``(l, G, R, R)``; the prior is no part of it."""
    moment: Tensor
    """``(l, G, R)``."""
    held_gram: Tensor
    """That of a surprising transition which the next one has to confirm."""
    held_moment: Tensor
    """``(l, G, R)``."""
    age: Tensor
    """Transitions since learning began or began anew, ``(l)``."""
    level: Tensor
    """Median surprise under the fit, at least 1: what passes for noise, ``(l)``."""
    quiet: Tensor
    """For how many transitions the nominal model has been as good as the fit, ``(l)``."""
    active: Tensor
    """Is there a fit? Otherwise the nominal model holds, ``(l)``."""
    surprised: Tensor
    """Was the last transition a surprise? ``(l)``."""
    explained: Tensor
    """Did the nominal model explain the last transition? ``(l)``."""
    score: Tensor
    """Mean log ratio of the squared errors of fit and nominal model, ``(l)``."""

    @property
    def known(self) -> Information:
        """The information of the transitions that count."""
        return Information(self.gram, self.moment)

    @property
    def better(self) -> Tensor:
        """Is the fit's squared error half the nominal model's, or less? ``(l)``.

        Judged by the latest transitions that either of them could not explain, each predicted
        before it was learnt from. A fit that explains little better is not worth a change.
        """
        return self.active & (self.score < -MARGIN)


class Rules(NamedTuple):
    """How a :class:`Memory` is kept."""

    forgetting: float = 0.97
    """Weight of a transition relative to the next one, in (0, 1]."""
    gate: float = 5.0
    """Surprise beyond which a transition is suspect, in standard deviations."""
    patience: int = 10
    """Transitions for which the nominal model is as good before the fit is dropped."""
    confirm: bool = True
    """Must the next transition confirm a surprise? False: a single one counts."""
    restart: bool = True
    """Is what was learnt before a confirmed surprise dropped? False: it is forgotten slowly."""


class Seen(NamedTuple):
    """The latest transition of each mission."""

    gram: Tensor
    """Its information, ``(l, G, R, R)``."""
    moment: Tensor
    """``(l, G, R)``."""
    surprise: Tensor
    """Error of the fit, in standard deviations of its prediction, ``(l)``."""
    error: Tensor
    """The same in standard deviations of the nominal model, ``(l)``."""
    nominal: Tensor
    """Error of the nominal model, in its standard deviations, ``(l)``."""
    exciting: Tensor
    """Does it say anything about slopes? ``(l)``."""
    valid: Tensor
    """Does it count at all? ``(l)``."""


class Verdict(NamedTuple):
    """What a transition was taken for."""

    began: Tensor
    """The regime changed: what was known before was dropped, ``(l)``."""
    ended: Tensor
    """The nominal dynamics are back: everything was dropped, ``(l)``."""


def blank(missions: int, regressions: int, size: int, like: Tensor) -> Memory:
    """Return the memory of missions that have seen nothing, in double precision.

    >>> blank(5, 2, 3, torch.zeros(1)).gram.shape
    torch.Size([5, 2, 3, 3])
    """
    gram = torch.zeros(missions, regressions, size, size, device=like.device, dtype=torch.float64)
    moment, count = gram[..., 0], torch.zeros(missions, device=like.device, dtype=torch.float64)
    no = torch.zeros(missions, device=like.device, dtype=torch.bool)
    known, state = (gram, moment, gram, moment), (count, count + 1, count)
    return Memory(*known, *state, active=no, surprised=no, explained=no, score=count - CREDIT)


def advance(
    memory: Memory, seen: Seen, rules: Rules, stay: Tensor | None = None
) -> tuple[Memory, Verdict]:
    """Take in one transition per mission: decide what it is, and learn accordingly.

    * A mission without a fit stays so until a surprise is confirmed.
    * A surprise under a fit of more than R + 1 transitions is held back. If the next one is no
      surprise, it was an outlier and is dropped. If it is, the regime has changed: both are
      kept and everything before them is forgotten; or, if the nominal model explains both, the
      fit is dropped.
    * A fit is dropped as well once the nominal model has been as good for long, unless
      ``stay``, ``(l)``, says that this proves nothing.
    * A surprise is measured by the noise that the fit has been living with, if that is more
      than the model's: a robot whose every step is a surprise is noisy, it does not change.

    Nothing happens to missions whose transition is not valid.
    """
    ready = memory.age > memory.moment.shape[-1] + 1
    suspect = seen.surprise > rules.gate
    hit = (seen.surprise > rules.gate * memory.level) & (ready | ~memory.active)
    confirmed = hit & (memory.surprised | (not rules.confirm))
    held = hit & ~confirmed
    explained = seen.nominal <= rules.gate
    as_good = explained & (seen.nominal <= NEAR * seen.surprise.clamp_min(1.0))
    quiet = torch.where(as_good, memory.quiet + seen.exciting, 0.0)
    long = quiet >= rules.patience
    if stay is not None:
        long = long & ~stay
    back = suspect & memory.surprised & explained & memory.explained
    ended = memory.active & (back | long) & seen.valid
    began = confirmed & (~memory.active | rules.restart) & ~ended & seen.valid

    learn = confirmed | (memory.active & ~held)
    keep = torch.where(learn & seen.exciting, rules.forgetting, 1.0).to(memory.level)
    keep = torch.where(began | ended, 0.0, keep)

    def grown(old: Tensor, waiting: Tensor, new: Tensor) -> Tensor:
        masks = (keep, confirmed & ~ended, learn & ~ended)
        kept, proven, taken = (mask.reshape(-1, *(1,) * (old.dim() - 1)) for mask in masks)
        return kept * old + torch.where(proven, waiting, 0.0) + torch.where(taken, new, 0.0)

    rise = torch.where(seen.surprise > memory.level, QUICK, -QUICK).exp()
    level = torch.where(memory.active & ready, memory.level * rise, memory.level)
    ratio = torch.log((1 + seen.error.square()) / (1 + seen.nominal.square()))
    telling = memory.active & ((seen.error > rules.gate) | ~explained)
    score = torch.where(telling, torch.lerp(ratio, memory.score, RECENT), memory.score)
    age = torch.where(began, 1.0 + memory.surprised, memory.age + learn)
    after = Memory(
        gram=grown(memory.gram, memory.held_gram, seen.gram),
        moment=grown(memory.moment, memory.held_moment, seen.moment),
        held_gram=torch.where(held[:, None, None, None], seen.gram, 0.0),
        held_moment=torch.where(held[:, None, None], seen.moment, 0.0),
        age=torch.where(ended, 0.0, age),
        level=torch.where(ended, 1.0, level).clamp(1.0, CEILING),
        quiet=torch.where(ended | began | ~memory.active, 0.0, quiet),
        active=(memory.active | confirmed) & ~ended,
        surprised=torch.where(hit, held, suspect & memory.active) & ~ended,
        explained=explained,
        score=torch.where(ended | began, -CREDIT, score),
    )
    parts = [where(seen.valid, new, old) for new, old in zip(after, memory, strict=True)]
    return Memory(*parts), Verdict(began, ended)


def pooled(
    news: Information,
    surprise: Tensor,
    error: Tensor,
    nominal: Tensor,
    exciting: Tensor,
    valid: Tensor,
) -> Seen:
    """Take n simultaneous transitions ``(l, n, ...)`` for one: their sum, their median surprise."""

    def total(part: Tensor) -> Tensor:
        counts = valid.reshape(*valid.shape, *(1,) * (part.dim() - 2))
        return torch.where(counts, part, 0.0).sum(1)

    def middle(part: Tensor) -> Tensor:
        return torch.where(valid, part, torch.nan).nanmedian(1).values.nan_to_num(0.0)

    typical = middle(surprise), middle(error), middle(nominal)
    gram, moment = (total(part) for part in news)
    return Seen(gram, moment, *typical, (exciting & valid).any(1), valid.any(1))


def where(missions: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return ``new`` for some ``missions`` ``(l)`` and ``old`` for the others, ``(l, ...)``."""
    return torch.where(missions.reshape(-1, *(1,) * (old.dim() - 1)), new, old)
