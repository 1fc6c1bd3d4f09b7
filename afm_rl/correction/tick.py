"""What happens at a tick: from what is remembered to the action that is executed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.achievable import MODES, attainable, extend
from afm_rl.correction.belief import Belief, mean_and_std, prior_of
from afm_rl.correction.believing import Answer
from afm_rl.correction.experts import MISSES, Rows, fit_experts
from afm_rl.correction.linear import LINEAR, Lines, fit_lines, sensor_noise
from afm_rl.correction.network import AxisNetwork, Encoded
from afm_rl.correction.readings import READINGS, Layout, late_ones, lay_out, read_rows
from afm_rl.correction.solver import midpoint
from afm_rl.errors import check_choice, check_count, check_number


class Models(NamedTuple):
    """What is believed of the next action: the models, or the most likely of them."""

    encoded: Encoded
    """What the K most likely readings of every axis have read, B K sets."""
    lines: Lines
    """The linear models."""
    weights: Tensor
    """Probabilities ``(B, 1 + K + L, A)``: that actions have their nominal effect, now or late;
    of the readings; of the linear models."""


class Tick(nn.Module):
    """The correction as one function of tensors, for B missions.

    A function of its arguments alone, so that it can run as machine code
    (:mod:`~afm_rl.compiling.machine_code`). The arguments are settings of
    :class:`~afm_rl.correction.ActionFlow`.
    """

    scale: Tensor
    points: Tensor
    probes: Tensor
    worth: Tensor
    late: Tensor
    rows_acting: Tensor

    def __init__(
        self,
        network: AxisNetwork,
        scale: Tensor,
        readings: Sequence[str],
        rows: int,
        worth: Tensor,
        odds: float,
        least_noise: float,
        likely: int,
        samples: int,
        source_std: float,
        steps: int,
        saturation: str,
    ) -> None:
        super().__init__()
        self.network, size = network, len(scale)
        self.odds, self.least_noise = odds, least_noise
        self.source_std = check_number("corrector.source_std", source_std, low=0.0)
        self.steps = check_count("corrector.steps", steps)
        self.saturation = check_choice("corrector.saturation", saturation, MODES)
        chosen = [READINGS[name] for name in readings]
        self.by_place = any(r.near for r in chosen)
        self.varied = sum(r.varied for r in chosen)
        self.counts = [1, len(chosen), len(LINEAR), len(late_ones(readings)), 1]
        self.likely = min(check_count("corrector.likely", likely), len(chosen))
        late = [k for k, name in enumerate(readings) if name in late_ones(readings)]
        fixed = {
            "scale": scale.to(network.modes),
            "points": points_of(check_count("corrector.samples", samples), size),
            "probes": probes_of(size),
            "worth": worth,
            "late": torch.tensor(late, dtype=torch.long),
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
        encoded, lines = self.read(pairs, noise, place)
        prior = prior_of(self.worth, self.odds, noise, self.least_noise)
        weights = Belief(losses, losses, noise).weights(prior)
        models = self.most_likely(encoded, lines, weights)
        proposals, spread = self.propose(models, unit, ends)
        expected = self.expect(models, proposals)
        reach = self.reach(models, expected)
        low, high = reach.unbind(-2)
        wanted = attainable(unit, low, high, self.saturation)
        sent = pairs[..., : len(self.scale)]
        tried = sent.amax(1) - sent.amin(1)
        bounds = extend(reach, ends, tried, self.saturation)
        action = self.decide(models, proposals, expected, wanted, noise)
        changed = weights[:, 0] + weights[:, -1] < 0.5  # else the plan, to the bit
        action = torch.where(changed & action.isfinite().all(-1, True), action, unit)
        predicted = self.mean(models, self.expect(models, action.unsqueeze(1)))[0].squeeze(1)
        forecasts = self.forecast(encoded, lines, pairs, action)
        return Answer(
            action * self.scale,
            predicted * self.scale,
            spread * self.scale,
            bounds * self.scale,
            changed.any(-1),
            forecasts,
        )

    def read(self, pairs: Tensor, noise: Tensor, place: Tensor) -> tuple[Encoded, Lines]:
        """Return what is read in every reading, B R sets of rows, and the linear models."""
        away, size = None, len(self.scale)
        if self.by_place:
            first = 3 * size + 2
            away = (pairs[..., first:] - place.unsqueeze(-2)).square().sum(-1)
            away = torch.where(pairs[..., first - 2] > 0, away, torch.inf)
        layout = Layout(*(getattr(self, f"rows_{name}") for name in Layout._fields))
        rows = read_rows(pairs, layout, size, away, self.varied)
        loud = torch.hypot(rows.std, noise[:, None, None]) * rows.valid
        rows = Rows(*(part.flatten(0, 1) for part in rows._replace(std=loud)))
        sent, came, std, valid = pairs[..., : 3 * size + 1].split([size, size, size, 1], -1)
        sound = (valid == 1.0).to(pairs)
        lines = fit_lines(sent, came, torch.hypot(std, noise.unsqueeze(1)), sound)
        return self.network.encode(rows, fit_experts(rows)), lines

    def most_likely(self, encoded: Encoded, lines: Lines, weights: Tensor) -> Models:
        """Return the most likely models of every axis."""
        still, read, linear, late, noisy = weights.split(self.counts, 1)
        # Of models that are alike the first, on any machine and in any batch.
        order = torch.arange(read.shape[1], device=read.device).view(-1, 1)
        best = (read * (1 - 1e-4 * order)).topk(self.likely, 1)
        which = encoded.choose(best.indices)
        share = best.values / best.values.sum(1, keepdim=True).clamp_min(1e-30)
        share = read.sum(1, keepdim=True) * share
        still = still + late.sum(1, keepdim=True) + noisy
        return Models(which, lines, torch.cat([still, share, linear], 1))

    def propose(self, models: Models, planned: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions ``(B, C, A)``, the first the planned one, and the samples' deviation.

        The flow's samples of the most likely reading, the exact answers of all fits, and a few
        actions from all over the box.
        """
        count, size = planned.shape
        plans = planned.repeat_interleave(self.likely, 0).unsqueeze(1)
        asked = self.network.ask(models.encoded, plans, self.saturation)
        first = asked.pick(torch.arange(count, device=planned.device) * self.likely)
        plan = planned.unsqueeze(1)
        start = plan + self.source_std * self.points
        ends = midpoint(partial(self.network.velocity, first), start, self.steps)
        mean, spread = ends.mean(1, keepdim=True), ends.std(1, correction=0)
        exact = asked.answers[..., 0, :MISSES].mT.reshape(count, -1, size)
        least, most = box.split(1, 1)
        probes = torch.lerp(least, most, 0.5 * (self.probes + 1))
        found = [plan, mean, ends, exact, models.lines.invert(planned), probes]
        return torch.cat(found, 1).clamp(least, most), spread

    def expect(self, models: Models, actions: Tensor) -> Tensor:
        """Return the effects ``(B, 1 + K + L, C, A)`` of actions ``(B, C, A)`` by every model."""
        each = actions.repeat_interleave(self.likely, 0)
        read = self.network.effect(models.encoded, each).unflatten(0, (-1, self.likely))
        return torch.cat([actions.unsqueeze(1), read, models.lines.effect(actions)], 1)

    def mean(self, models: Models, expected: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of effects over the models, ``(B, C, A)`` each."""
        weights = models.weights.unsqueeze(2)
        return mean_and_std(expected.transpose(1, 2), weights.transpose(1, 2))

    def reach(self, models: Models, foreseen: Tensor) -> Tensor:
        """Return the lowest and highest effects that actions may have, ``(B, 2, A)``.

        As far as the models differ, the best is hoped for: a planner that may try learns more.
        """
        mean, std = self.mean(models, foreseen)
        return torch.stack([(mean - std).amin(1), (mean + std).amax(1)], 1)

    def decide(
        self, models: Models, proposals: Tensor, expected: Tensor, wanted: Tensor, noise: Tensor
    ) -> Tensor:
        r"""Return the actions ``(B, A)`` with the least expected loss.

        .. math:: u_a = \operatorname{argmin}_u \sum_h w_{ha}
                  \log\Big(1 + \frac{(T_{ha}(u) - u^*_a)^2}{s_a^2}\Big)

        over the proposals, axis by axis, if these actions together are no worse than the best
        proposal as a whole, as they may be where one command moves several axes. The loss averages
        models that differ by less than the noise s, and decides between those that differ by
        more: half of two opposite answers would do nothing, and tell nothing.
        """
        cost = self.loss(models, expected, wanted, noise)  # (B, C, A)
        mixed = proposals.gather(1, cost.argmin(1, keepdim=True))
        joint = cost.sum(-1).argmin(1)[:, None, None].expand_as(mixed)
        again = self.loss(models, self.expect(models, mixed), wanted, noise)
        whole = cost.gather(1, joint).sum(-1, keepdim=True)
        better = again.sum(-1, keepdim=True) <= whole + 1e-6
        return torch.where(better, mixed, proposals.gather(1, joint)).squeeze(1)

    def loss(self, models: Models, expected: Tensor, wanted: Tensor, noise: Tensor) -> Tensor:
        """Return the expected loss ``(B, C, A)`` of effects ``(B, 1 + K + L, C, A)``."""
        miss = (expected - wanted[:, None, None]).square() / noise[:, None, None].square()
        return (models.weights.unsqueeze(2) * miss.log1p()).sum(1)

    def forecast(self, encoded: Encoded, lines: Lines, pairs: Tensor, executed: Tensor) -> Tensor:
        """Return the effects ``(B, M + 1, A)`` that all models expect of what acts now."""
        size, now = len(self.scale), executed.unsqueeze(1)
        sent = torch.cat([pairs[..., :size], now], -2)
        acted = self.rows_acting @ sent[:, -self.rows_acting.shape[-1] :]  # (B, R, A)
        read = self.network.effect(encoded, acted.reshape(-1, 1, size)).view_as(acted)
        linear = lines.effect(now).squeeze(2)
        before, came, _, valid = pairs[..., : 3 * size + 1].split([size, size, size, 1], -1)
        noisy = now + sensor_noise(before, came, (valid == 1.0).to(now))
        return torch.cat([now, read, linear, acted[:, self.late], noisy], 1)


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
