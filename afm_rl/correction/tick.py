"""What happens at a tick: from what is remembered to the action that is executed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import somewhere
from afm_rl.correction.achievable import attainable, extend
from afm_rl.correction.belief import mean_and_std
from afm_rl.correction.context_windows import ContextWindows
from afm_rl.correction.delay import align, command_acting
from afm_rl.correction.experts import MISSES, Rows, fit_experts
from afm_rl.correction.hypotheses import KINDS, Hypothesis, acting_of
from afm_rl.correction.least_squares import fit_gain, precision_of
from afm_rl.correction.linear import (
    MIXING,
    LinearModels,
    Lines,
    at_rest,
    sensor_noise,
    within_rate,
)
from afm_rl.correction.network import AxisNetwork, Encoded, midpoint

AT_END = 1e-4  # shares of the largest action: a command so near an end of the box stands at it


class Answer(NamedTuple):
    """What the models make of plans; actions are shares of the largest one."""

    executed: Tensor
    """The action, ``(B, A)``."""
    predicted: Tensor
    """The effect that is expected of it, ``(B, A)``."""
    spread: Tensor
    """Standard deviation of the proposals, ``(B, A)``."""
    bounds: Tensor
    """Lowest and highest effect that an action may have, ``(B, 2, A)``."""
    corrects: Tensor
    """Is any model believed more than that nothing has changed? ``(B)``."""
    forecasts: Tensor
    """The effects that the models expect of what acts now, shares of the largest action,
    ``(B, M, A)``; the first is that of *nothing has changed*."""
    under_way: Tensor
    """The effects that the newest commands have or will have, likewise, ``(B, K + D, A)``."""
    unmet: Tensor
    """What the box could not give of the plans, ``(B, A)``; zero where a command is within it."""


class Fits(NamedTuple):
    """All models, fitted to the memory."""

    encoded: Encoded
    """The network's code of each of R context windows, B R sets."""
    lines: Lines
    """The linear models."""
    gains: Tensor
    """Of commands that are delayed in W ways, ``(B, W, A)``."""
    gain_variances: Tensor
    """Of these gains, in units of the noise, ``(B, W, A)``."""
    sensor_noise: Tensor
    """What sensor noise adds to the next effect, ``(B, 1, A)``."""
    rate_limits: Tensor
    """Lowest and highest effect at the rate seen recently, ``(B, 2, A)``."""
    series: tuple[Tensor, Tensor, Tensor]
    """Commands that acted, their effects, and which of them count, the oldest first."""


class Models(NamedTuple):
    """The models of which an action is chosen."""

    encoded: Encoded
    """The most likely context window of every axis."""
    lines: Lines
    """The linear models, the first one a gain of delayed commands."""
    weights: Tensor
    """Probabilities ``(B, 2 + L, A)``: that actions have their nominal effect, delayed or not; of
    the network; of the linear models."""


class Forecast(NamedTuple):
    """What every model of :class:`Models` expects of C actions, ``(B, 2 + L, C, A)`` each."""

    effect: Tensor
    """Shares of the largest action."""
    variance: Tensor
    """Of the fits, in units of the noise."""

    def at(self, which: Tensor) -> Forecast:
        """Return the forecast of other actions, of which each axis has an index ``(B, K, A)``."""
        which = which.unsqueeze(1).expand(-1, self.effect.shape[1], -1, -1)
        return Forecast(self.effect.gather(2, which), self.variance.gather(2, which))


class Tick(nn.Module):
    """The correction as one function of tensors, for B missions.

    A function of its arguments alone, so that it can run as machine code
    (:mod:`~afm_rl.compiling.machine_code`). The arguments are settings of
    :class:`~afm_rl.correction.ActionFlow`.
    """

    scale: Tensor
    points: Tensor
    probes: Tensor
    delays: Tensor
    tie_break: Tensor
    filters: Tensor
    filter_of_model: Tensor
    mixing: Tensor
    acting: Tensor
    windows: Tensor

    def __init__(
        self,
        network: AxisNetwork,
        scale: Tensor,
        hypotheses: Sequence[Hypothesis],
        rows: int,
        samples: int,
        source_std: float,
        steps: int,
        saturation: str,
    ) -> None:
        super().__init__()
        self.network, self.rows, size = network, rows, len(scale)
        self.source_std, self.steps, self.saturation = source_std, steps, saturation
        kinds = {kind: [row for row in hypotheses if row.kind == kind] for kind in KINDS}
        self.counts = [len(of_kind) for of_kind in kinds.values()]
        self.linear = LinearModels([row.fit for row in hypotheses if row.fit is not None])
        self.context = ContextWindows([row.name for row in kinds["network"]], rows, size)
        acting = acting_of([*kinds["nominal"], *kinds["delay"]])
        delays = torch.tensor([-1 if row.follows_delay else row.delay for row in hypotheses])
        self.longest_delay = max(delays.tolist())
        filters, which = filters_of(acting_of(hypotheses))
        fixed = {
            "scale": scale.to(network.modes),
            "points": points_of(samples, size),
            "probes": probes_of(size),
            "delays": delays,
            # Of windows with equal probability the first, on any machine and in any batch.
            "tie_break": 1 - 1e-4 * torch.arange(self.counts[1]).unsqueeze(-1),
            "filters": filters,
            "filter_of_model": torch.nn.functional.one_hot(which).T.to(scale),
            "mixing": torch.tensor([row.mixes_axes for row in kinds["linear"]]).unsqueeze(-1),
            "windows": torch.arange(rows).unsqueeze(-1) + torch.arange(acting.shape[-1]),
            "acting": acting,
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self,
        pairs: Tensor,
        weights: Tensor,
        noise: Tensor,
        place: Tensor,
        delay: Tensor,
        waiting: Tensor,
        planned: Tensor,
        box: Tensor,
        unmet: Tensor,
    ) -> Answer:
        """Return the answers to the plans of B missions.

        Args:
            pairs: what is remembered, the newest last, ``(B, M, D)``.
            weights: probabilities of the H models, ``(B, H, A)``.
            noise: that no model explains, ``(B, A)``.
            place: where the missions are, ``(B, P)``.
            delay: of commands, in steps, ``(B,)``.
            waiting: commands that are known to come, the oldest first, ``(B, D, A)``.
            planned: the planned action, ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
            unmet: what the box could not give of the last one, ``(B, A)``; where this one goes the
                other way it is added, so that plans that alternate keep their mean.
        """
        plan = planned.clamp(*box.unbind(1))
        fits = self.fit(pairs, noise, place, delay)
        healthy = weights[:, 0] + weights[:, -self.counts[-1] :].sum(1)
        changed = healthy < 0.5  # else the plan, to the bit
        still = [plan, plan, torch.zeros_like(plan), box]

        def corrected() -> tuple[Tensor, ...]:
            models = self.most_likely(fits, weights)
            asked = planned + torch.where(planned * unmet < 0, unmet, 0.0)
            proposals, spread = self.propose(models, asked, box)
            expected = self.expect(models, proposals)
            reach = self.reach(models, expected.effect)
            low, high = reach.unbind(-2)
            wanted = attainable(asked, low, high, self.saturation)
            sent = pairs[..., : len(self.scale)]
            bounds = extend(reach, box, sent.amax(1) - sent.amin(1))
            action, effects = self.decide(models, proposals, expected, wanted, noise)
            lag = (self.filter_of_model.to(weights) @ weights).argmax(1)  # the most probable one

            def against_lag() -> tuple[Tensor, Tensor]:
                command, acts = self.lead(action, lag, torch.cat([sent, waiting], 1), box)
                return command, self.expect(models, acts.unsqueeze(1)).effect.squeeze(2)

            action, effects = somewhere((lag > 0).any(-1), against_lag, [action, effects])
            corrects = changed & action.isfinite().all(-1, True)
            action = torch.where(corrects, action, plan)
            effects = torch.where(corrects.unsqueeze(1), effects, expected.effect[:, :, 0])
            return action, (models.weights * effects).sum(1), spread, bounds

        action, predicted, spread, bounds = somewhere(changed.any(-1), corrected, still)
        low, high = box.unbind(1)  # one action alone, where nothing is to be corrected
        at_end = (low < high) & ((action <= low + AT_END) | (action >= high - AT_END))
        unmet = torch.where(changed & at_end, planned - predicted, 0.0).clamp(-1.0, 1.0)
        ahead = torch.cat([waiting, action.unsqueeze(1)], 1)
        forecasts, under_way = self.forecast(fits, weights, delay, pairs, ahead)
        changed = changed.any(-1)
        return Answer(action, predicted, spread, bounds, changed, forecasts, under_way, unmet)

    def fit(self, pairs: Tensor, noise: Tensor, place: Tensor, delay: Tensor) -> Fits:
        """Return all models, fitted to the memory; see :meth:`forward`."""
        size = len(self.scale)
        aligned = align(pairs, delay, size)
        rows = self.context(aligned, place)
        std = torch.hypot(rows.std, noise[:, None, None]) * rows.valid
        rows = Rows(*(part.flatten(0, 1) for part in rows._replace(std=std)))
        encoded = self.network.encode(rows, fit_experts(rows))
        acted, effect, std, valid = aligned[..., : 3 * size + 1].split([size, size, size, 1], -1)
        recent = (valid == 1.0).to(pairs)
        weight = precision_of(torch.hypot(std, noise.unsqueeze(1)), recent)
        newest = pairs[:, 1 - self.rows - self.acting.shape[-1] :, :size]
        delayed = (self.acting @ newest[:, self.windows]).transpose(1, 2)  # (B, W, K, A)
        last = slice(-self.rows, None)
        gains = fit_gain(delayed, effect[:, None, last], weight[:, None, last])
        lines = self.linear(pairs[..., :size], acted, effect, weight, noise)
        limits = within_rate(effect, recent)
        series = acted, effect, recent
        errors = sensor_noise(*series)
        return Fits(encoded, lines, *gains, errors, limits, series)

    def most_likely(self, fits: Fits, weights: Tensor) -> Models:
        """Return the models of which an action is chosen."""
        nominal, network, linear, delay, gain, healthy = weights.split(self.counts, 1)
        encoded = fits.encoded.choose((network * self.tie_break).argmax(1))
        way = gain.argmax(1, keepdim=True)
        delayed = torch.diag_embed(fits.gains.gather(1, way))  # (B, 1, A, A)
        variance = fits.gain_variances.gather(1, way)[..., None, None]
        of_gain = torch.nn.functional.pad(variance, (1, 0, 1, 0))  # its offset is zero
        lines = fits.lines._replace(
            matrix=torch.cat([delayed, fits.lines.matrix], 1),
            bias=torch.nn.functional.pad(fits.lines.bias, (0, 0, 1, 0)),
            covariance=torch.cat([of_gain, fits.lines.covariance], 1),
        )
        nominal = torch.cat([nominal, delay, healthy], 1).sum(1, keepdim=True)
        network, gain = (part.sum(1, keepdim=True) for part in (network, gain))
        return Models(encoded, lines, torch.cat([nominal, network, gain, linear], 1))

    def propose(self, models: Models, planned: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions ``(B, C, A)``, the first the planned one, and the samples' deviation.

        The flow's samples, the exact answers of all fits, and a few actions from all over the box.
        """
        plan = planned.unsqueeze(1)
        plan_code = self.network.ask(models.encoded, plan, self.saturation)
        start = plan + self.source_std * self.points
        ends = midpoint(partial(self.network.velocity, plan_code), start, self.steps)
        mean, spread = ends.mean(1, keepdim=True), ends.std(1, correction=0)
        exact = plan_code.answers[..., 0, :MISSES].mT
        least, most = box.split(1, 1)
        probes = torch.lerp(least, most, 0.5 * (self.probes + 1))
        proposals = [plan, mean, ends, exact, models.lines.invert(planned), probes]
        return torch.cat(proposals, 1).clamp(least, most), spread

    def expect(self, models: Models, actions: Tensor) -> Forecast:
        """Return what every model expects of actions ``(B, C, A)``."""
        effect, variance = self.network.forecast(models.encoded, actions)
        effects = [actions.unsqueeze(1), effect.unsqueeze(1), models.lines.effect(actions)]
        spread = [variance.unsqueeze(1), models.lines.variance(actions)]
        sure = torch.zeros_like(effects[0])  # that commands do as they say
        return Forecast(torch.cat(effects, 1), torch.cat([sure, *spread], 1))

    def reach(self, models: Models, effects: Tensor) -> Tensor:
        """Return the lowest and highest effects that actions may have, ``(B, 2, A)``.

        Optimistic bounds, mean plus or minus one standard deviation over the models, so that the
        planner explores.
        """
        weights = models.weights.unsqueeze(2)
        mean, std = mean_and_std(effects.transpose(1, 2), weights.transpose(1, 2))
        return torch.stack([(mean - std).amin(1), (mean + std).amax(1)], 1)

    def decide(
        self,
        models: Models,
        proposals: Tensor,
        expected: Forecast,
        wanted: Tensor,
        noise: Tensor,
    ) -> tuple[Tensor, Tensor]:
        r"""Return the actions ``(B, A)`` with the least expected loss, and what models expect.

        .. math:: u_a = \operatorname{argmin}_u \sum_h w_{ha}
                  \log\Big(1 + \frac{(T_{ha}(u) - u^*_a)^2}{s_a^2}\Big)

        with the wanted effect :math:`u^*`, the forecasts T and the probabilities w of the models,
        over the proposals that the evidence reaches (:meth:`rate`), axis by axis, if these actions
        together are no worse than the best proposal as a whole, as they may be where one command
        moves several axes. The loss averages models that differ by less than the noise s, and
        decides between those that differ by more: half of two opposite answers would do nothing,
        and tell nothing. So would small actions in noise: the plan is kept where they save less
        than .02 of expected loss.
        """
        loss, axis, whole = self.rate(models, proposals, expected, wanted, noise)  # (B, C, A)
        cost = torch.cat([loss[:, :1] - 0.02, loss[:, 1:]], 1)
        each = torch.where(axis, cost, torch.inf).argmin(1, keepdim=True)
        least, joint = torch.where(whole, cost.sum(-1, keepdim=True), torch.inf).min(1, True)
        joint = joint.expand_as(each)
        action, effect = proposals.gather(1, joint), expected.at(joint).effect

        def by_axis() -> tuple[Tensor, Tensor]:
            which = torch.cat([torch.zeros_like(each), each], 1)
            actions = proposals.gather(1, which)
            own = expected.at(which)  # of the models that mix no axes
            effect_of_all, variance = models.lines.mixing(actions)
            forecast = Forecast(
                torch.cat([own.effect[:, :-MIXING], effect_of_all], 1),
                torch.cat([own.variance[:, :-MIXING], variance], 1),
            )
            loss, _, whole = self.rate(models, actions, forecast, wanted, noise)
            better = whole[:, 1:] & (loss[:, 1:].sum(-1, keepdim=True) <= least + 1e-6)
            return (
                torch.where(better, actions[:, 1:], action),
                torch.where(better.unsqueeze(1), forecast.effect[:, :, 1:], effect),
            )

        differ = (each != joint).flatten(1).any(-1)
        action, effect = somewhere(differ, by_axis, [action, effect])
        return action.squeeze(1), effect.squeeze(2)

    def rate(
        self, models: Models, actions: Tensor, expected: Forecast, wanted: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return the expected loss of actions ``(B, C, A)``, and which the evidence reaches.

        It does if half of the probability is with models that promise at least twice their standard
        deviation :math:`\sigma`: that the miss is so much less than that of the first
        action, which is the plan :math:`u_0`,

        .. math:: \sum_h w_{ha} \big[\,|T_{ha}(u_0) - u^*_a| - |T_{ha}(u) - u^*_a|
                  \ge 2 \sigma_{ha}(u)\big] \ge \tfrac12 \sum_h w_{ha},

        axis by axis ``(B, C, A)``; and as a whole ``(B, C, 1)``, where axes count as far as they
        move away from the plan. A line through commands that were nearly alike explains them, and
        knows nothing of others: where :math:`\sigma` is half of the largest action, a model has no
        part in the sums.
        """
        weights, square = models.weights.unsqueeze(2), noise[:, None, None].square()
        misses = (expected.effect - wanted[:, None, None]).square()
        loss = (weights * (misses / square).log1p()).sum(1)
        misses, std = misses.sqrt(), (expected.variance * square).sqrt()
        promised = misses[:, :, :1] - misses >= 2 * std - 1e-6
        excess = weights * (std < 0.5) * (promised.to(weights) - 0.5)
        excess, moved = excess.sum(1) - 1e-6, (actions - actions[:, :1]).abs()
        return loss, (excess > 0) | (moved == 0), (excess * moved).sum(-1, keepdim=True) >= 0

    def lead(self, acts: Tensor, lag: Tensor, sent: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the commands ``(B, A)`` after which ``acts`` acts, and what acts after them.

        .. math:: u = (v - (1 - c) \bar u) / c

        as far as the box allows, where the actuator makes :math:`c u + (1 - c) \bar u` of this
        command and those before it.

        Args:
            acts: v, what should act, ``(B, A)``.
            lag: by which filter commands act, ``(B, A)``.
            sent: commands until now, the newest last, ``(B, N, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
        """
        shares = self.filters[lag]  # (B, A, L)
        before = sent[:, sent.shape[1] - shares.shape[-1] + 1 :].mT
        rest, share = (shares[..., :-1] * before).sum(-1), shares[..., -1]
        action = ((acts - rest) / share).clamp(box[:, 0], box[:, 1])
        return action, share * action + rest

    def forecast(
        self, fits: Fits, weights: Tensor, delay: Tensor, pairs: Tensor, ahead: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the effects ``(B, H, A)`` that all models expect of what acts now.

        And those ``(B, K + D, A)`` that the newest commands have or will have, by the models with
        the present delay; the commands themselves where none is to come.

        Args:
            fits: all models.
            weights: their probabilities, ``(B, H, A)``.
            delay: of commands, in steps, ``(B,)``.
            pairs: what is remembered.
            ahead: commands that wait, and the present one, ``(B, D + 1, A)``.
        """
        commands, now = torch.cat([pairs[..., : len(self.scale)], ahead], 1), ahead[:, :1]
        acted = commands[:, : pairs.shape[1] + 1]
        acts = command_acting(acted, delay).unsqueeze(1)
        delayed = self.acting @ acted[:, -self.acting.shape[-1] :]  # (B, W, A)
        newest = commands[:, -max(1, self.longest_delay + ahead.shape[1] - 1) :]
        shape = -1, self.counts[1], acts.shape[-1]
        each = acts.expand(shape).flatten(0, 1).unsqueeze(1)
        network = self.network.effect(fits.encoded, each).view(shape)
        each = torch.where(self.mixing, now, acts).unsqueeze(2)  # (B, L, 1, A)
        linear = fits.lines.effect(each).squeeze(2)
        healthy = [
            acts.clamp(*fits.rate_limits.split(1, 1)),
            acts + fits.sensor_noise,
            at_rest(acts, *fits.series),
            acts,
        ]
        forecasts = [now, network, linear, delayed[:, 1:], fits.gains * delayed, *healthy]

        def under_way() -> list[Tensor]:
            has_delay = ((self.delays < 0) | (self.delays == delay.unsqueeze(-1))).unsqueeze(-1)
            models = self.most_likely(fits, torch.where(has_delay, weights.clamp_min(1e-9), 0.0))
            shares = models.weights / models.weights.sum(1, keepdim=True)
            return [(shares.unsqueeze(2) * self.expect(models, newest).effect).sum(1)]

        (newest,) = somewhere(delay + ahead.shape[1] > 1, under_way, [newest])
        return torch.cat(forecasts, 1), newest


def filters_of(acting: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ways ``(F, L)`` in which actuators are slow, and that of each model ``(M,)``.

    The first is that they are not, as where commands are late and no more.

    >>> filters_of(torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.4, 0.6]]))
    (tensor([[0.0000, 1.0000],
            [0.4000, 0.6000]]), tensor([0, 0, 1]))
    """
    newest = torch.zeros_like(acting)
    newest[:, -1] = 1.0
    slow = ((acting > 0).sum(-1, keepdim=True) > 1) & (acting[:, -1:] > 0)
    return torch.where(slow, acting, newest).unique(dim=0, return_inverse=True)


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
