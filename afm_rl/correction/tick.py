"""What happens at a tick: from what is remembered to the action that is executed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.choice import nearest_of, probes_of, source_points_of
from afm_rl.correction.hypotheses import HYPOTHESES, IDENTITY, Layout, lay_out, read_rows
from afm_rl.errors import check_choice, check_count, check_number
from afm_rl.flow.experts import Experts, Rows, fit_experts
from afm_rl.flow.network import AxisNetwork, Encoded
from afm_rl.flow.saturation import DEAD, MODES, attainable, cut_off
from afm_rl.flow.solver import midpoint

TOLERANCE = 0.25  # of the largest action: at an error of this size the loss is half its maximum
FORGIVEN = 0.02  # loss of a hypothesis that explains all that it has read
LATE = -0.01  # of one that finds nothing but a delay, with its penalty
EXCITED = 0.05  # range of the actions that show whether an axis is dead
LEAST_WIDTH = 0.02  # of the box: effects that a planner may still ask for


class Answer(NamedTuple):
    """What a tick makes of plans."""

    losses: Tensor
    """Of the hypotheses, ``(B, H + 1)``."""
    forecasts: Tensor
    """Effects predicted of what acts now, shares of the largest action, ``(B, H + 1, A)``."""
    acting: Tensor
    """The one that is believed, in units of the action, ``(B, A)``."""
    executed: Tensor
    """The action, in its own units, ``(B, A)``."""
    predicted: Tensor
    """The effect that it is predicted to have, in units of the action, ``(B, A)``."""
    spread: Tensor
    """Of the samples, in units of the action, ``(B, A)``."""
    bounds: Tensor
    """Lowest and highest effect, in units of the action, ``(B, 2, A)``."""
    misaligned: Tensor
    """Is a correction believed? ``(B)``."""


class Tick(nn.Module):
    """Hypotheses, experts, flow and choice as one function of tensors, for B missions.

    A function of its arguments alone, so that it can run as machine code
    (:mod:`~afm_rl.compiling.machine_code`). The arguments are settings of
    :class:`~afm_rl.correction.ActionFlow`.
    """

    scale: Tensor
    source_points: Tensor
    probes: Tensor
    penalty: Tensor
    late: Tensor
    rows_acting: Tensor

    def __init__(
        self,
        network: AxisNetwork,
        scale: Tensor,
        hypotheses: Sequence[str],
        identity: bool,
        rows: int,
        memory: int,
        forgetting: float,
        samples: int,
        source_std: float,
        steps: int,
        choose: str,
        saturation: str,
    ) -> None:
        super().__init__()
        self.network, self.memory = network, memory
        self.count, size = len(hypotheses), len(scale)
        self.forgetting = check_number("corrector.forgetting", forgetting, low=0.0, high=1.0)
        self.source_std = check_number("corrector.source_std", source_std, low=0.0)
        self.steps = check_count("corrector.steps", steps)
        self.choose = check_choice("corrector.choose", choose, ("best", "mean"))
        self.saturation = check_choice("corrector.saturation", saturation, MODES)
        chosen = [HYPOTHESES[name] for name in hypotheses]
        self.by_place = any(h.near for h in chosen)
        self.varied = sum(h.varied for h in chosen)
        never = 0.0 if identity else torch.inf
        penalty = [h.penalty for h in chosen] + [HYPOTHESES[IDENTITY].penalty + never]
        fixed = {
            "scale": scale.to(network.modes),
            "source_points": source_points_of(check_count("corrector.samples", samples), size),
            "probes": probes_of(size),
            "penalty": torch.tensor(penalty),
            "late": torch.tensor([float(h.delay + h.lag) for h in chosen]),
        }
        fixed |= {f"rows_{k}": part for k, part in lay_out(chosen, rows)._asdict().items()}
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self,
        pairs: Tensor,
        losses: Tensor,
        forecasts: Tensor,
        misaligned: Tensor,
        place: Tensor,
        planned: Tensor,
        box: Tensor,
    ) -> Answer:
        """Return the answer for B missions whose model is misaligned.

        Args:
            pairs: what is remembered, the newest last, ``(B, M, D)``.
            losses: of the hypotheses before the newest pair, ``(B, H + 1)``.
            forecasts: effects that they predicted of it, ``(B, H + 1, A)``.
            misaligned: was anything predicted? ``(B, 1)``.
            place: where the missions are, ``(B, P)``.
            planned: in units of the action, ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
        """
        unit, ends = planned / self.scale, box / self.scale
        encoded = self.encode(pairs, place)
        losses = self.judge(pairs, losses, forecasts, misaligned)
        losses = self.forgive(losses, encoded.experts)
        belief = (losses + self.penalty).argmin(-1)
        sent = pairs[..., : len(self.scale)]
        tried = sent.amax(-2) - sent.amin(-2)
        known = self.pick(encoded, belief)
        action, effect, spread, bounds = self.propose(known, unit, ends, tried)
        bounds = self.hope(tried, ends, bounds)
        sound = (action + effect).isfinite().all(-1)
        believed = sound & (belief < self.count)
        action = torch.where(believed.unsqueeze(-1), action, unit)
        forecasts = self.predict(encoded, pairs, action)
        acting = forecasts.gather(1, belief[:, None, None].expand(-1, 1, len(self.scale)))
        found = torch.stack([action, effect], -2) * self.scale
        found = torch.where(believed[:, None, None], found, planned.unsqueeze(-2))
        bounds = torch.where(believed[:, None, None], bounds * self.scale, box)
        executed, effect = found.unbind(-2)
        return Answer(
            losses,
            forecasts,
            acting.squeeze(1) * self.scale,
            executed,
            effect,
            spread * self.scale,
            bounds,
            believed,
        )

    def judge(self, pairs: Tensor, losses: Tensor, forecasts: Tensor, misaligned: Tensor) -> Tensor:
        """Return the hypotheses' losses ``(B, H + 1)`` after the newest pair."""
        size = len(self.scale)
        newest = pairs[:, -1:]
        effective, std = newest[..., size : 2 * size], newest[..., 2 * size : 3 * size]
        tolerance = TOLERANCE**2
        miss = (forecasts - effective).square()
        share = miss / ((miss + tolerance) * (1 + std.square() / tolerance))
        valid = newest[..., 3 * size]
        return self.forgetting * losses + valid * misaligned * share.mean(-1)

    def forgive(self, losses: Tensor, experts: Experts) -> Tensor:
        """Return losses that are small where a line explains all that a hypothesis has read.

        Its first forecasts were guesses: one pair does not tell a gain from an offset. Where
        actions have their nominal effect, only late, that is believed before any line: of plans
        that change slowly, a late one looks like an offset.
        """
        line, nominal = (part.view(-1, self.count) for part in experts.explained())
        read, identity = losses.split([self.count, 1], -1)  # the identity reads nothing
        read = torch.where(line, read.clamp_max(FORGIVEN), read)
        late = nominal & (self.late > 0)
        return torch.cat([torch.where(late, LATE - self.penalty[:-1], read), identity], -1)

    def encode(self, pairs: Tensor, place: Tensor) -> Encoded:
        """Return what the network reads under every hypothesis, B H sets of rows."""
        away, size = None, len(self.scale)
        if self.by_place:
            first = 3 * size + 2
            away = (pairs[..., first:] - place.unsqueeze(-2)).square().sum(-1)
            away = torch.where(pairs[..., first - 2] > 0, away, torch.inf)
        layout = Layout(*(getattr(self, f"rows_{name}") for name in Layout._fields))
        rows = read_rows(pairs, layout, size, away, self.varied)
        rows = Rows(*(part.flatten(0, 1) for part in rows))
        return self.network.encode(rows, fit_experts(rows))

    def pick(self, encoded: Encoded, belief: Tensor) -> Encoded:
        """Return what is read under one hypothesis for each mission, ``(B,)``.

        The first stands in for the identity, which reads nothing.
        """
        first = torch.arange(belief.shape[0], device=belief.device) * self.count
        return encoded.pick(first + belief.where(belief < self.count, 0))

    def propose(
        self, known: Encoded, planned: Tensor, box: Tensor, tried: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return action, predicted effect and spread ``(B, A)``, and bounds ``(B, 2, A)``.

        Args:
            known: what is read under the hypothesis that is believed.
            planned: u, ``(B, A)``.
            box: its lowest and highest, ``(B, 2, A)``.
            tried: range of the remembered actions, ``(B, A)``.
        """
        # Where a line explains all rows, it is believed to go on where nothing was tried.
        line = known.experts.lines(box)
        plans = planned.unsqueeze(-2)
        if self.saturation != "clip":  # for an axis without influence nothing need be slower
            small = line.diff(dim=-2).abs() < DEAD * box.diff(dim=-2)
            # Of an action that never changed it is not known what another one would do.
            dead = small & (tried > EXCITED).unsqueeze(-2)
            plans = torch.where(dead, line.mean(-2, keepdim=True), plans)
        asked = self.network.ask(known, plans, self.saturation)
        velocity = partial(self.network.velocity, asked)
        start = plans + self.source_std * self.source_points
        ends = midpoint(velocity, start, self.steps)
        mean, spread = ends.mean(-2, keepdim=True), ends.std(-2, correction=0)
        proposals = mean
        if self.choose == "best":  # mixtures come near; an expert that explains all is exact
            sure = known.experts.sure().unsqueeze(-1)
            exact = torch.where(sure, asked.answers[..., 0, :-1].mT, mean)
            proposals = torch.cat([mean, ends, exact], -2)
        least, most = box.split(1, -2)
        proposals = torch.minimum(torch.maximum(proposals, least), most)
        count = proposals.shape[-2]
        probes = torch.lerp(least, most, 0.5 * (self.probes + 1))
        foreseen = self.network.effect(known, torch.cat([proposals, probes], -2))
        effects, found = foreseen[:, :count], foreseen[:, count:]
        low, high = found.amin(-2), found.amax(-2)
        low, high = torch.fmin(low, line.amin(-2)), torch.fmax(high, line.amax(-2))
        wanted = attainable(plans.squeeze(-2), low, high, self.saturation)
        best = nearest_of(effects, wanted, 0.5 * (high - low))
        chosen = torch.cat([proposals, effects], -1)
        chosen = chosen.gather(-2, best.expand(best.shape[0], 1, chosen.shape[-1])).squeeze(-2)
        action, effect = chosen.tensor_split(2, -1)
        return action, effect, spread, torch.stack([low, high], -2)

    def hope(self, tried: Tensor, box: Tensor, bounds: Tensor) -> Tensor:
        """Return the bounds of effects ``(B, 2, A)`` that plans should keep.

        Smaller than the box only where most of it was tried of late: what was not tried may do
        what the model says. And only where the saturation cuts a plan: where it makes the robot
        slower instead, plans may ask for more.

        Args:
            tried: range of the remembered actions, ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
            bounds: lowest and highest effect that is predicted of them, ``(B, 2, A)``.
        """
        (least, most), (low, high) = box.unbind(-2), bounds.unbind(-2)
        width = most - least
        left = (1 - tried / width).clamp_min(LEAST_WIDTH) * width
        left = torch.where(cut_off((high - low) / width, self.saturation), left, width)
        low = torch.fmin(low, torch.fmax(low - left, least))
        high = torch.fmax(high, torch.fmin(high + left, most))
        return torch.stack([low, high], -2)

    def predict(self, encoded: Encoded, pairs: Tensor, executed: Tensor) -> Tensor:
        """Return the effects ``(B, H + 1, A)`` that the hypotheses predict of what acts now."""
        size = len(self.scale)
        sent = torch.cat([pairs[..., :size], executed.unsqueeze(-2)], -2)
        acted = self.rows_acting @ sent[:, -self.rows_acting.shape[-1] :]  # (B, H, A)
        effects = self.network.effect(encoded, acted.reshape(-1, 1, size)).view_as(acted)
        return torch.cat([effects, executed.unsqueeze(-2)], -2)
