"""What happens at a tick: from what is remembered to the action that is executed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.achievable import MODES, attainable
from afm_rl.correction.belief import Belief, mean_and_std
from afm_rl.correction.experts import MISSES, Rows, fit_experts
from afm_rl.correction.network import AxisNetwork, Encoded
from afm_rl.correction.pairs import Answer
from afm_rl.correction.readings import READINGS, Layout, lay_out, models_of, read_rows
from afm_rl.correction.solver import midpoint
from afm_rl.errors import check_choice, check_count, check_number


class Likely(NamedTuple):
    """The K most likely models of every axis, and *nothing has changed*."""

    encoded: Encoded
    """What they read, B K sets."""
    head: Tensor
    """Which of the heads answers, ``(B, K, A)``."""
    weights: Tensor
    """Their probabilities, the first that of *nothing has changed*, ``(B, K + 1, A)``."""


class Tick(nn.Module):
    """The correction as one function of tensors, for B missions.

    A function of its arguments alone, so that it can run as machine code
    (:mod:`~afm_rl.compiling.machine_code`). The arguments are settings of
    :class:`~afm_rl.correction.ActionFlow`.
    """

    scale: Tensor
    points: Tensor
    probes: Tensor
    prior: Tensor
    reading: Tensor
    head: Tensor
    rows_acting: Tensor

    def __init__(
        self,
        network: AxisNetwork,
        scale: Tensor,
        readings: Sequence[str],
        rows: int,
        prior: Tensor,
        likely: int,
        samples: int,
        source_std: float,
        steps: int,
        saturation: str,
    ) -> None:
        super().__init__()
        self.network, size = network, len(scale)
        self.source_std = check_number("corrector.source_std", source_std, low=0.0)
        self.steps = check_count("corrector.steps", steps)
        self.saturation = check_choice("corrector.saturation", saturation, MODES)
        chosen = [READINGS[name] for name in readings]
        self.by_place = any(r.near for r in chosen)
        self.varied = sum(r.varied for r in chosen)
        reading, head = models_of(chosen)
        self.likely = min(check_count("corrector.likely", likely), len(head))
        fixed = {
            "scale": scale.to(network.modes),
            "points": points_of(check_count("corrector.samples", samples), size),
            "probes": probes_of(size),
            "prior": prior,
            "reading": torch.tensor(reading),
            "head": torch.tensor(head),
        }
        fixed |= {f"rows_{k}": part for k, part in lay_out(chosen, rows)._asdict().items()}
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self,
        pairs: Tensor,
        losses: Tensor,
        noise: Tensor,
        place: Tensor,
        planned: Tensor,
        box: Tensor,
    ) -> Answer:
        """Return the answers to the plans of B missions.

        Args:
            pairs: what is remembered, the newest last, ``(B, M, D)``.
            losses: of the models, ``(B, M + 1, A)``.
            noise: that no model explains, ``(B, A)``.
            place: where the missions are, ``(B, P)``.
            planned: in units of the action, ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
        """
        unit, ends = planned / self.scale, box / self.scale
        weights = Belief(losses, losses, noise).weights(self.prior)
        encoded = self.encode(pairs, noise, place)
        models = self.most_likely(encoded, weights)
        proposals, spread = self.propose(models, unit, ends)
        probes = torch.lerp(ends[:, :1], ends[:, 1:], 0.5 * (self.probes + 1))
        expected = self.expect(models, torch.cat([proposals, probes], 1))
        known, foreseen = expected.split([proposals.shape[1], probes.shape[1]], 2)
        bounds = self.reach(models, foreseen)
        wanted = attainable(unit, *bounds.unbind(-2), self.saturation)
        action = self.decide(models, proposals, known, wanted)
        action = torch.where(action.isfinite().all(-1, True), action, unit)
        predicted = self.mean(models, self.expect(models, action.unsqueeze(1)))[0].squeeze(1)
        forecasts = self.forecast(encoded, pairs, action)
        return Answer(
            action * self.scale,
            predicted * self.scale,
            spread * self.scale,
            bounds * self.scale,
            (weights.argmax(1) > 0).any(-1),
            forecasts,
        )

    def encode(self, pairs: Tensor, noise: Tensor, place: Tensor) -> Encoded:
        """Return what is read in every reading, B R sets of rows."""
        away, size = None, len(self.scale)
        if self.by_place:
            first = 3 * size + 2
            away = (pairs[..., first:] - place.unsqueeze(-2)).square().sum(-1)
            away = torch.where(pairs[..., first - 2] > 0, away, torch.inf)
        layout = Layout(*(getattr(self, f"rows_{name}") for name in Layout._fields))
        rows = read_rows(pairs, layout, size, away, self.varied)
        loud = torch.hypot(rows.std, noise[:, None, None]) * rows.valid
        rows = Rows(*(part.flatten(0, 1) for part in rows._replace(std=loud)))
        return self.network.encode(rows, fit_experts(rows))

    def most_likely(self, encoded: Encoded, weights: Tensor) -> Likely:
        """Return the most likely models of every axis."""
        best = weights[:, 1:].topk(self.likely, 1)
        which = encoded.choose(self.reading[best.indices])
        weights = torch.cat([weights[:, :1], best.values], 1)
        return Likely(which, self.head[best.indices], weights / weights.sum(1, keepdim=True))

    def propose(self, models: Likely, planned: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions ``(B, C, A)``, the first the planned one, and the samples' deviation.

        The flow's samples of the most likely model, and the exact answers of all fits.
        """
        count, likely, size = models.head.shape
        plans = planned.unsqueeze(1).repeat_interleave(likely, 0)
        asked = self.network.ask(models.encoded, plans, self.saturation)
        first = asked.pick(torch.arange(count, device=planned.device) * likely)
        plan = planned.unsqueeze(1)
        start = plan + self.source_std * self.points
        ends = midpoint(partial(self.network.velocity, first), start, self.steps)
        mean, spread = ends.mean(1, keepdim=True), ends.std(1, correction=0)
        shift = models.encoded.experts.shift.mT.to(plans)
        exact = torch.cat([asked.answers[..., 0, :MISSES].mT, plans - shift], 1)
        found = [plan, mean, ends, exact.view(count, -1, size)]
        least, most = box.split(1, 1)
        return torch.cat(found, 1).clamp(least, most), spread

    def expect(self, models: Likely, actions: Tensor) -> Tensor:
        """Return the effects ``(B, K + 1, C, A)`` of actions ``(B, C, A)`` by every model."""
        count, likely, size = models.head.shape
        each = actions.repeat_interleave(likely, 0)
        heads = self.network.effects(models.encoded, each)  # (B K, A, C, 8)
        which = models.head.view(-1, size, 1, 1).expand(*heads.shape[:-1], 1)
        effects = heads.gather(-1, which).squeeze(-1).mT.unflatten(0, (count, likely))
        return torch.cat([actions.unsqueeze(1), effects], 1)

    def mean(self, models: Likely, expected: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of effects over the models, ``(B, C, A)`` each."""
        weights = models.weights.unsqueeze(2)
        return mean_and_std(expected.transpose(1, 2), weights.transpose(1, 2))

    def reach(self, models: Likely, foreseen: Tensor) -> Tensor:
        """Return the lowest and highest effects that actions may have, ``(B, 2, A)``.

        As far as the models differ, the best is hoped for: a planner that may try learns more.
        """
        mean, std = self.mean(models, foreseen)
        return torch.stack([(mean - std).amin(1), (mean + std).amax(1)], 1)

    def decide(self, models: Likely, proposals: Tensor, expected: Tensor, wanted: Tensor) -> Tensor:
        r"""Return the actions ``(B, A)`` with the least expected squared miss.

        .. math:: u_a = \operatorname{argmin}_u \sum_h w_{ha} (T_{ha}(u) - u^*_a)^2

        over the proposals, axis by axis, if these actions together are no worse than the best
        proposal as a whole, as they may be where one command moves several axes.
        """
        misses = (expected - wanted[:, None, None]).square()
        cost = (models.weights.unsqueeze(2) * misses).sum(1)  # (B, C, A)
        each = cost.argmin(1, keepdim=True)
        mixed = proposals.gather(1, each)
        joint = cost.sum(-1).argmin(1)[:, None, None].expand_as(mixed)
        whole = proposals.gather(1, joint)
        again = (self.expect(models, mixed) - wanted[:, None, None]).square()
        worth = (models.weights.unsqueeze(2) * again).sum(1).sum(-1, keepdim=True)
        better = worth <= cost.gather(1, joint).sum(-1, keepdim=True) + 1e-9
        return torch.where(better, mixed, whole).squeeze(1)

    def forecast(self, encoded: Encoded, pairs: Tensor, executed: Tensor) -> Tensor:
        """Return the effects ``(B, M + 1, A)`` that all models expect of what acts now."""
        size = len(self.scale)
        sent = torch.cat([pairs[..., :size], executed.unsqueeze(-2)], -2)
        acted = self.rows_acting @ sent[:, -self.rows_acting.shape[-1] :]  # (B, R, A)
        heads = self.network.effects(encoded, acted.reshape(-1, 1, size)).squeeze(2)
        heads = heads.unflatten(0, acted.shape[:2])  # (B, R, A, 8)
        effects = heads[:, self.reading, :, self.head].movedim(0, 1)
        return torch.cat([executed.unsqueeze(1), effects], 1)


def points_of(count: int, size: int) -> Tensor:
    """Return normal points ``(count, A)``, the same ones always; each has its opposite."""
    half = torch.randn((count + 1) // 2, size, generator=torch.Generator().manual_seed(0))
    return torch.cat([half, -half])[:count]


def probes_of(size: int, count: int = 32) -> Tensor:
    """Return actions ``(P, A)`` in [-1, 1]: ends of the axes, and between them.

    >>> probes_of(1)[:2].tolist()
    [[1.0], [-1.0]]
    """
    ends = torch.cat([torch.eye(size), -torch.eye(size)])
    inner = torch.quasirandom.SobolEngine(size).draw(max(1, count - 2 * size))
    return torch.cat([ends, 2 * inner - 1])
