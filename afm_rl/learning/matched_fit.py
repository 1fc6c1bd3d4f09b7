"""The matched part of a calibration: what other actions can undo."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.dynamics.hammerstein import PLAIN
from afm_rl.learning.effects import Effect
from afm_rl.learning.kept import Kept
from afm_rl.learning.recursive_least_squares import LEAST, Information, absorb, fading, solve
from afm_rl.learning.regime_memory import CREDIT, Memory, Rules, advance, blank, pooled, where
from afm_rl.learning.shape_search import Rows, features_of, latest, search, surprises, told_by

EXCITING = 0.05  # half ranges: a smaller action tells nothing about slopes
SETTLED = 8  # transitions without surprise after which a surprise begins something new
ENOUGH, SHARE = 8, 0.9  # transitions that a shape needs, and how many of them it must explain
FIRST = 16  # rows for which it is searched at each surprise, and at each fourth row later
GAIN = 10.0  # by how much it must lower the cost
EXACT, ROUGH = 1e-3, 1.0  # mean squared surprise of a fit with and without shape that is left alone


class Watch(NamedTuple):
    """The shape in use, and when to look for another."""

    shape: Tensor
    """``(l, 3)``."""
    since: Tensor
    """Rows since a surprise began something new, ``(l)``."""
    calm: Tensor
    """Transitions without a surprise, ``(l)``."""


class MatchedFit(nn.Module):
    """D, b and a shape per mission, from what actions turned out to be worth.

    Args:
        prior: information of the prior of D and b side by side, around identity, ``(A, A + 1)``.
        rules: of the memory.
        window: transitions among which a shape is looked for; 0 for no shapes.
    """

    prior: Tensor

    def __init__(self, prior: Tensor, rules: Rules, window: int) -> None:
        super().__init__()
        self.rules, self.window = rules, window
        self.register_buffer("prior", prior, persistent=False)
        self.memory, self.rows, self.watch = (Kept(part) for part in self._blank(0, prior))

    def clear(self, missions: int, like: Tensor) -> None:
        """Forget everything."""
        parts = self._blank(missions, like)
        for kept, part in zip((self.memory, self.rows, self.watch), parts, strict=True):
            kept.keep(part)

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index``."""
        for kept in (self.memory, self.rows, self.watch):
            kept.select_(index)

    def learn(self, action: Tensor, effect: Effect, valid: Tensor) -> None:
        """Take in n transitions per mission.

        Args:
            action: u, ``(l, n, A)``.
            effect: what they were worth, ``(l, n, ...)``.
            valid: which of them count, ``(l, n)``.
        """
        memory: Memory = self.memory.parts
        theta, covariance = self._fit()
        features = features_of(action, self.watch.parts.shape.unsqueeze(1))
        doubt = torch.einsum("lnr,lgrk,lnk->lng", features, covariance, features)
        doubt = where(memory.active, doubt, torch.zeros_like(doubt))
        miss = (effect.effective - features @ theta.mT).square() * effect.weight
        nominal = (effect.effective - action).square() * effect.weight
        surprise, error, usual = (
            part.amax(-1).sqrt() for part in (miss / (1 + effect.weight * doubt), miss, nominal)
        )
        nothing = Information(*(torch.zeros_like(part).unsqueeze(1) for part in memory.known))
        news = absorb(nothing, features, effect.effective, effect.weight)
        exciting = (action.abs() > EXCITING).any(-1)
        seen = pooled(news, surprise, error, usual, exciting, valid)
        after, verdict = advance(memory, seen, self.rules, stay=self._shaped)
        self.memory.keep(after)
        if not self.window:
            return
        counts = valid.unsqueeze(-1)
        fresh = action, effect.effective, effect.weight * counts
        blanked = (torch.where(counts, part, 0.0) for part in fresh)
        pairs = zip(self.rows.parts, blanked, strict=True)
        self.rows.keep(Rows(*(torch.cat(pair, 1)[:, -self.window :] for pair in pairs)))
        each, surprised = valid.shape[1], seen.surprise > self.rules.gate
        shape, since, calm = self.watch.parts
        since = where(verdict.ended, torch.zeros_like(since), since + each * seen.valid)
        since = where(surprised & (calm >= SETTLED), torch.full_like(since, each), since)
        calm = where(surprised, torch.zeros_like(calm), calm + seen.valid)
        lost = (verdict.began & self._shaped) | verdict.ended
        self.watch.keep(Watch(shape, since, calm))
        self._take(lost, torch.tensor(PLAIN).to(shape).expand_as(shape), after.age * each)
        shaped, age = self._shaped, self.memory.parts.age
        often, seldom = (
            (since <= FIRST * each) | (since % 4 == 0),
            (since <= each) | (since % 8 == 0),
        )
        due = torch.where(shaped, surprised | (age <= 2 * self.window), surprised & often)
        self._look(latest(self.rows.parts, torch.where(shaped, age * each, since)), due)
        whole = torch.full_like(since, self.window)
        self._look(latest(self.rows.parts, whole), surprised & seldom & ~self._shaped)

    def calibration(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return D ``(l, A, A)``, b ``(l, A)`` and the shape ``(l, 3)`` to be believed now."""
        theta, _ = self._fit()
        better, shape = self.memory.parts.better, self.watch.parts.shape
        theta = where(better, theta, self._mean)
        shape = where(better, shape, torch.tensor(PLAIN).to(shape).expand_as(shape))
        return theta[..., :-1], theta[..., -1], shape

    def _blank(self, missions: int, like: Tensor) -> tuple[Memory, Rows, Watch]:
        size = self.prior.shape[0]
        memory = blank(missions, size, size + 1, like)
        count = memory.age
        row = count.new_zeros(missions, self.window, size)
        return (
            memory,
            Rows(row, row, row),
            Watch(count.new_tensor(PLAIN).repeat(missions, 1), count, count),
        )

    @property
    def _mean(self) -> Tensor:
        """The identity as a fit, ``(l, A, A + 1)``."""
        moment = self.memory.parts.moment
        return torch.eye(*self.prior.shape).to(moment).expand_as(moment)

    @property
    def _shaped(self) -> Tensor:
        """Which missions have a shape, ``(l)``."""
        shape = self.watch.parts.shape
        return (shape != torch.tensor(PLAIN).to(shape)).any(-1)

    def _fit(self) -> tuple[Tensor, Tensor]:
        """Return mean and covariance of D and b side by side, ``(l, A, A + 1)``."""
        memory: Memory = self.memory.parts
        prior = fading(self.prior.to(memory.gram), memory.age)
        theta, covariance = solve(memory.known, prior, self._mean)
        return where(memory.active, theta, self._mean), covariance

    def _take(self, chosen: Tensor, shape: Tensor, count: Tensor) -> None:
        """Give ``chosen`` missions a shape, and what the latest ``count`` rows tell under it."""
        if not bool(chosen.any()):
            return
        memory: Memory = self.memory.parts
        shape = where(chosen, shape, self.watch.parts.shape)
        self.watch.keep(self.watch.parts._replace(shape=shape))
        told, _ = told_by(latest(self.rows.parts, count, self.rules.forgetting), shape)
        gram, moment = (where(chosen, *pair) for pair in zip(told, memory.known, strict=True))
        self.memory.keep(memory._replace(gram=gram, moment=moment))

    def _look(self, rows: Rows, due: Tensor) -> None:
        """Look for a shape where it is ``due`` and the fit leaves something of these rows."""
        memory: Memory = self.memory.parts
        shape, cap, shaped = self.watch.parts.shape, self.rules.gate, self._shaped
        features = features_of(rows.action, shape.unsqueeze(1))
        cost = surprises(rows, features, self._fit()[0]).clamp_max(cap**2).sum(-1)
        count = (rows.weight > 0).any(-1).sum(-1)
        left = cost > torch.where(shaped, EXACT, ROUGH) * count
        index = (due & left & (count >= ENOUGH)).nonzero().squeeze(-1)
        if not len(index):
            return
        weak = self.prior * LEAST
        found = search(Rows(*(part[index] for part in rows)), weak, cap)
        good = found.cost < cost[index] - torch.where(shaped[index], 0.0, GAIN)
        good &= found.cost < found.plain - GAIN
        good &= found.cost <= (1 - SHARE) * cap**2 * count[index]
        chosen = torch.zeros_like(shaped).index_fill(0, index[good], True)
        first = chosen & ~(shaped & memory.active)
        self.memory.keep(
            memory._replace(
                age=where(chosen, count.to(memory.age), memory.age),
                active=memory.active | chosen,
                surprised=memory.surprised & ~chosen,
                score=where(first, torch.full_like(memory.score, -CREDIT), memory.score),
                level=where(first, torch.ones_like(memory.level), memory.level),
                quiet=where(first, torch.zeros_like(memory.quiet), memory.quiet),
            )
        )
        self._take(chosen, shape.index_copy(0, index, found.shape), count)
