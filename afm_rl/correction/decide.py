"""Which command is executed: proposals, and the one with the least expected loss."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from afm_rl.compiling.tracing import all_hold, none_holds, same
from afm_rl.correction.achievable import attainable, extend
from afm_rl.correction.belief import visible
from afm_rl.correction.records import Memory, Plan, Settings
from afm_rl.correction.regression import Fits
from afm_rl.correction.table import LEAST_GAIN, Table
from afm_rl.spaces.small_matrices import invert_positive

LEAST_SAVING = 0.02  # of expected loss, that another command than the plan has to bring
UNSURE = 0.5  # standard deviation of an effect from which on a hypothesis promises nothing
REST = 0.1  # share of a plan below which a command tells nothing
SAME = 1e-6  # of losses and misses that are alike


class Bounds(NamedTuple):
    """Lowest and highest values, ``(B, A)`` each."""

    low: Tensor
    high: Tensor


def sustainable(table: Table, memory: Memory, plan: Plan, fits: Fits, weights: Tensor) -> Tensor:
    r"""Return the planned action ``(B, A)``; of plans that alternate, what the bounds can sustain.

    An actuator :math:`v_k = g u_k + a v_{k-1} + b` whose effect swings by s around a mean takes
    commands :math:`((1 - a)\,\text{mean} - b \pm (1 + a)\,s) / g`. If these leave the bounds, less
    of the swing is asked for, and all of the mean: else commands would stand at both bounds in
    turn, whatever the mean. By the likeliest hypothesis, if that is such a line.
    """
    turns = memory.plans.diff(dim=-1)
    alternates = (turns[..., 1:] * turns[..., :-1] < 0).all(-1)
    if none_holds(alternates):
        return plan.action
    best = weights.argmax(-1)
    is_line, lagging = table.linear[best], table.lagging[best]
    best = best[..., None].clamp_max(len(table.rows) - 1)
    gain, offset = (fits.curves[..., k].gather(-1, best).squeeze(-1) for k in (0, -1))
    last = fits.coefficients[..., -1].gather(-1, best).squeeze(-1)
    a, b = lagging * last, (1 - lagging) * offset
    mean, swing = memory.plans[..., -2:].mean(-1), 0.5 * turns[..., -1]
    centre = ((1 - a) * mean - b) * gain / (gain.square() + LEAST_GAIN**2)
    room = (plan.high - centre).minimum(centre - plan.low).clamp_min(0.0)
    limit = room * gain.abs() / (1 + a)
    return torch.where(alternates & is_line, mean + swing.clamp(-limit, limit), plan.action)


def propose(table: Table, plan: Plan, fits: Fits, wanted: Tensor) -> Tensor:
    """Return C commands ``(B, A, 1, C)``, the first the planned action ``wanted`` ``(B, A)``.

    The inverse of every row, by a grid where it is curved; probes from all over the box; and the
    inverses of the maps, which change the plan no more than they must.
    """
    planned = wanted[..., None]
    seen = visible(fits.hidden, planned)
    gain, offset = fits.curves[..., 0], fits.curves[..., -1]
    inverses = gain * (seen - offset) / (gain.square() + LEAST_GAIN**2)
    miss = (fits.curves[..., table.curved, :] @ table.grid_basis - seen[..., None]).abs()
    of_curves = table.grid[(miss + table.grid_cost).argmin(-1)]
    answers = torch.cat([of_curves, inverses], -1)
    if fits.hidden is not None:
        answers = planned + visible(fits.hidden, answers - seen)
    commands = [planned, answers, table.probes.expand(*wanted.shape, -1)]
    if fits.maps is not None:
        matrix, constant = fits.maps.transpose(-3, -2).split([wanted.shape[-1], 1], -1)
        left = seen.unsqueeze(-3) - constant - matrix @ planned.unsqueeze(-3)
        transposed = matrix.mT
        inverse = invert_positive(transposed @ matrix + table.least_square_gain)
        commands.append(planned + (inverse @ (transposed @ left)).squeeze(-1).mT)
    within = torch.cat(commands, -1).clamp(plan.low[..., None], plan.high[..., None])
    return within[..., None, :]


class Forecast(NamedTuple):
    """What the K hypotheses that can be inverted expect of C commands."""

    effects: Tensor
    """Shares of the largest action, ``(B, A, K, C)``."""
    variances: Tensor
    """In variances of the noise, ``(B, A, K, C)``."""
    mean: Tensor
    """Mean of the effects, ``(B, A, 1, C)``."""

    @classmethod
    def of(cls, table: Table, fits: Fits, weights: Tensor, commands: Tensor) -> Forecast:
        """Return the forecast of commands ``(B, A, 1, C)``, for weights ``(B, A, 1, K)``."""
        x = table.basis(visible(fits.hidden, commands))
        effects, x = fits.curves @ x, x[..., None, :, :]
        variances = ((fits.covariance @ x) * x).sum(-2) + table.feature_variance
        if fits.maps is not None and fits.map_covariance is not None:
            inputs = pad(commands.transpose(-3, -2), (0, 0, 0, 1), value=1.0)  # (B, 1, A + 1, C)
            affine = ((fits.map_covariance @ inputs) * inputs).sum(-2, True)
            variances = torch.cat([variances, pad(affine, (0, 0, 0, 1))], -2)
            effects = torch.cat([effects, fits.maps @ inputs], -2)
        return cls(effects, variances, weights @ effects)


def achievable(table: Table, fits: Fits, plan: Plan, weights: Tensor, forecast: Forecast) -> Bounds:
    """Return between which effects plans should stay.

    Optimistic, one standard deviation over the hypotheses beyond their mean, so that the planner
    explores. An actuator with a lag reaches everything, in time.
    """
    mean = forecast.mean
    std = (weights @ forecast.effects.square() - mean.square()).clamp_min(0.0).sqrt()
    in_time = (weights @ table.lagging > 0.5).squeeze(-1)
    if fits.hidden is not None:
        in_time = in_time | _redundant(fits.hidden)
    low = torch.where(in_time, plan.low, (mean - std).amin((-2, -1)))
    return Bounds(low, torch.where(in_time, plan.high, (mean + std).amax((-2, -1))))


def _redundant(hidden: Tensor) -> Tensor:
    """Return of which missions the model does not see all commands, ``(B, 1)``."""
    return (hidden != 0).any(-1).any(-1, True)


def attainable_plan(
    settings: Settings, memory: Memory, fits: Fits, plan: Plan, planned: Tensor, bounds: Bounds
) -> tuple[Tensor, Bounds]:
    """Return the effect to ask for ``(B, A)``, and the bounds that plans should keep."""
    low, high = plan.low.minimum(planned), plan.high.maximum(planned)
    if not all_hold((bounds.low <= low) & (bounds.high >= high)):
        planned = attainable(planned, *bounds, settings.saturation)
        tried = memory.commands.amax(-1) - memory.commands.amin(-1)
        reach, ends = torch.stack([*bounds], -2), torch.stack([plan.low, plan.high], -2)
        bounds = Bounds(*extend(reach, ends, tried).unbind(-2))
    return visible(fits.hidden, planned), bounds


def is_doubted(weights: Tensor) -> Tensor:
    """Return where healthy hypotheses, the first of ``(B, A, K)``, have half the belief at most."""
    return weights[..., 0] <= 0.5


def is_corrected(fits: Fits, weights: Tensor, command: Tensor) -> Tensor:
    """Return where the plan is replaced, ``(B, A)``; of redundant actuators on all, or on none."""
    corrected = is_doubted(weights) & command.isfinite()
    if fits.hidden is None:
        return corrected
    return corrected | corrected.any(-1, True) & _redundant(fits.hidden)


def choose(
    table: Table,
    fits: Fits,
    weights: Tensor,
    commands: Tensor,
    forecast: Forecast,
    wanted: Tensor,
    noise: Tensor,
) -> tuple[Tensor, Tensor]:
    r"""Return the commands with the least expected loss, and their expected effects, ``(B, A)``.

    .. math:: u = \operatorname{argmin}_u \sum_a \sum_h w_{ha}
              \log\Big(1 + \frac{(T_{ha}(u) - u^*_a)^2}{s_a^2}\Big)

    over the proposals that the evidence supports: axis by axis if the result is no worse than the
    best proposal as a whole, as it may be where one command moves several axes. The loss averages
    hypotheses that differ by less than the noise s, and decides between those that differ by more.
    The plan is kept where another command saves less than .02, for small actions teach nothing.

    Args:
        table: the hypotheses.
        fits: of them.
        weights: probabilities of what can be inverted, ``(B, A, 1, K)``.
        commands: ``(B, A, 1, C)``, the first the plan.
        forecast: of these.
        wanted: effect, ``(B, A)``.
        noise: ``(B, A)``.
    """
    wanted, noise = wanted[..., None, None], noise[..., None, None]
    goal = Goal.of(weights, wanted, noise, commands[..., :1], forecast.effects[..., :1])
    rating = goal.rate(commands, forecast)
    supported = (rating.excess > 0) & rating.tells | (rating.moved == 0)
    together, loss = rating.together, rating.loss
    loss[..., 0].sub_(LEAST_SAVING)
    least, joint = torch.where(together, loss.sum(-3), torch.inf).min(-1, True)
    joint = joint.unsqueeze(-3).expand_as(wanted)
    each = torch.where(supported, loss, torch.inf).argmin(-1, True)
    command, effect = commands.gather(-1, joint), forecast.mean.gather(-1, joint)
    if not all_hold(each == joint):
        apart = commands.gather(-1, each)
        forecast = Forecast.of(table, fits, weights, apart)
        rating = goal.rate(apart, forecast)
        better = (rating.together & (rating.loss.sum(-3) <= least + SAME)).unsqueeze(-3)
        command = torch.where(better, apart, command)
        effect = torch.where(better, forecast.mean, effect)
    return command.flatten(-3), effect.flatten(-3)


def limited(
    table: Table, fits: Fits, weights: Tensor, plan: Plan, command: Tensor, effect: Tensor
) -> tuple[Tensor, Tensor]:
    """Return a command ``(B, A)`` within the limits of this step, and its expected effect."""
    within = command.clamp(plan.limit_low, plan.limit_high)
    if same(within, command):
        return command, effect
    return within, Forecast.of(table, fits, weights, within[..., None, None]).mean.flatten(-3)


class Goal(NamedTuple):
    """What is wanted of commands, and the plan, with which they are compared."""

    weights: Tensor
    """Probabilities of what can be inverted, ``(B, A, 1, K)``."""
    wanted: Tensor
    """Effect, ``(B, A, 1, 1)``."""
    noise: Tensor
    """``(B, A, 1, 1)``."""
    plan: Tensor
    """The planned command, ``(B, A, 1, 1)``."""
    miss: Tensor
    """How far its effects are from the wanted one, in standard deviations, ``(B, A, K, 1)``."""
    telling: Tensor
    """Size from which on a command gives information, ``(B, A, 1, 1)``: a plan below the noise is
    not replaced by zero, which would give none."""

    @classmethod
    def of(
        cls, weights: Tensor, wanted: Tensor, noise: Tensor, plan: Tensor, effects: Tensor
    ) -> Goal:
        """Return the goal for a plan ``(B, A, 1, 1)`` with the effects ``(B, A, K, 1)``."""
        size, miss = plan.abs(), ((effects - wanted) / noise).abs()
        return cls(weights, wanted, noise, plan, miss, REST * size * (size < noise))

    def rate(self, commands: Tensor, forecast: Forecast) -> Rating:
        """Return how commands ``(B, A, 1, C)`` compare with the plan."""
        miss = ((forecast.effects - self.wanted) / self.noise).abs()
        loss = self.weights @ miss.square().log1p()
        std = forecast.variances.clamp_min(0.0).sqrt()
        promised = (self.miss - miss).sub(std, alpha=2) >= -SAME
        sure = std * self.noise < UNSURE
        excess = self.weights @ (sure * (promised.to(miss) - 0.5)) - SAME
        return Rating(loss, excess, (commands - self.plan).abs(), commands.abs() >= self.telling)


class Rating(NamedTuple):
    r"""How commands compare with the plan :math:`u_0`, ``(B, A, 1, C)`` each.

    A command is supported if

    .. math:: \sum_h w_h \big[\,|T_h(u_0) - u^*| - |T_h(u) - u^*| \ge 2\sigma_h(u)\big]
              \ge \tfrac12 \sum_h w_h,

    by axis, and for all axes :attr:`together`, weighted by their change. Hypotheses with a
    standard deviation above half of the largest action do not count.
    """

    loss: Tensor
    """The expected loss."""
    excess: Tensor
    """How much more than half of the probability is with hypotheses under which the error is
    smaller than the error of the plan by at least two standard deviations."""
    moved: Tensor
    """The change of the plan."""
    tells: Tensor
    """Does the command give information?"""

    @property
    def together(self) -> Tensor:
        """Which commands the evidence supports for all axes together, ``(B, 1, C)``."""
        return ((self.excess * self.moved).sum(-3) >= 0) & self.tells.any(-3)
