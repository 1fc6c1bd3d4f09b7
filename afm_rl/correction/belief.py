"""Which hypothesis is believed: losses of their forecasts, noise, and when a change began."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from afm_rl.compiling.tracing import none_holds
from afm_rl.correction.records import Measurement, Memory, Settings
from afm_rl.correction.table import LOSS_RANGE, Table

LEAST_NOISE, LEAST_COMMAND = 0.02, 0.25  # least noise, a share of the largest command, or of this
LARGEST_EFFECT = 4.0  # shares of the largest action: what is beyond is clipped
SHARED, DOUBT = 0.5, 7.0  # probability that all axes share a fault; nats that an axis may object
SURPRISE, CALM, TRACE = 5.0, 0.1, 0.8  # standard deviations; trace without one; its forgetting
USUAL_RATE, USUAL_SHARE = 0.05, 1 / 3  # of steps that exceed the usual innovation
OLD = 0.5  # validity of pairs from before a change


def remember(memory: Memory, measured: Measurement) -> Memory:
    """Return the memory with the newest N pairs; the last N - 1 of it are replaced.

    Those from before a change stay old, and so do those whose effects are not known. Where there is
    no reading, the context stays the last one.
    """
    count, kept = measured.validity.shape[-1], memory.validity.shape[-1]
    newest = {
        "commands": measured.commands,
        "effects": measured.effects.clamp(-LARGEST_EFFECT, LARGEST_EFFECT),
        "stds": measured.stds.clamp_max(LARGEST_EFFECT),
        "validity": measured.validity,
    }
    if count > 1:
        before = pad(memory.validity[..., kept - count + 1 :], (0, 1), value=1.0)
        newest["validity"] = measured.validity.minimum(before)
    if memory.contexts.shape[-2]:
        here, last = measured.contexts, memory.contexts[..., -1:]
        newest["contexts"] = torch.where(here.isfinite(), here, last)
    fields = memory._asdict()
    pairs = {
        name: torch.cat([fields[name][..., 1 : kept + 1 - count], pair], -1)
        for name, pair in newest.items()
    }
    hidden = memory.hidden if measured.hidden is None else measured.hidden
    return memory._replace(hidden=hidden, **pairs)


def visible(hidden: Tensor | None, commands: Tensor) -> Tensor:
    """Return P times commands ``(B, A, ...)``: what the model sees of them; all if None is hidden.

    >>> visible(torch.eye(2)[None], torch.ones(1, 2))
    tensor([[0., 0.]])
    """
    if hidden is None:
        return commands
    return commands - (hidden @ commands.reshape(*hidden.shape[:-1], -1)).view_as(commands)


def believe(
    table: Table, settings: Settings, memory: Memory, measured: Measurement
) -> tuple[Memory, Tensor, Tensor]:
    r"""Return the memory with what the newest pair showed, and where to correct ``(B,)``.

    Between them: where a change is believed, ``(B, 1)``.

    .. math::

        l_h &\leftarrow \big(1 - (1 - \alpha) q\big)\, l_h + \frac{\nu + 1}{2}
        \log\Big(1 + \frac{(v - T_h)^2}{\nu\,(s^2 + \sigma^2)}\Big) \\
        s^2 &\leftarrow s^2 + \beta\,\frac{s^2}{s^2 + \sigma^2}
        \big(\min\{\max\{(v - T_*)^2 - \sigma^2, 0\}, 3 s^2\} - s^2\big)

    with the forecasts :math:`T_h`, that of the likeliest hypothesis :math:`T_*`, the learnt noise
    s, the standard deviation :math:`\sigma` of the effect v, and the weight q of a pair in noise.

    Args:
        table: the hypotheses.
        settings: of the belief.
        memory: with the newest pair.
        measured: the pair.
    """
    effect, std, valid = memory.effects[..., -1:], memory.stds[..., -1], memory.validity[..., -1:]
    stated, variance, known = std.square(), memory.noise.square(), valid > 0
    total = stated + variance
    # Each hypothesis loses by how far its forecast was off, under Student's t distribution.
    error = torch.cat([memory.expected[..., None], memory.forecasts[..., :-1]], -1)
    error = visible(measured.hidden, error - effect).square()
    off, miss = error[..., 0], error[..., 1:]
    dof = settings.student_t_dof
    loss = 0.5 * (dof + 1) * (miss / (dof * total)[..., None]).log1p()
    miss, loss = _with_changing_delay(table, miss, loss)
    log_prior, weight, floor = prior(table, settings, memory)
    kept = 1 - (1 - settings.discount) * weight[..., None]
    losses = torch.where(known[..., None], loss.addcmul(kept, memory.losses), memory.losses)
    # The noise follows what the likeliest hypothesis missed.
    likeliest = (losses - log_prior).argmin(-1, True)
    excess = (miss.gather(-1, likeliest).squeeze(-1) - stated).clamp_min(0.0).minimum(3 * variance)
    rate = settings.noise_learning_rate * valid * variance / total
    noise = torch.lerp(variance, excess, rate).sqrt().maximum(floor)
    # A change begins when it is believed first, or by a surprise after calm steps.
    losses = _within_range(table, settings, memory.losses, losses)
    before, changed = (is_changed(settings, of) for of in (memory.losses, losses))
    off = (off > SURPRISE**2 * total) & known
    surprising = measured.innovation > gate(settings, memory)
    passed = valid * (1 - memory.corrected)
    # Or by the first unusual innovation of an executed plan: its effects may each be uncertain.
    first = surprising & (passed > 0) & (memory.usual == 0)
    sudden = first | (off & (memory.surprises < CALM)).any(-1, True)
    is_old = (changed & (~before | sudden)) & table.is_before_newest
    validity = torch.where(is_old, memory.validity.clamp_max(OLD), memory.validity)
    # What two of three innovations do not exceed is usual: no model is exact.
    more = surprising.to(valid) - USUAL_SHARE
    usual = memory.usual.addcmul(passed, more, value=USUAL_RATE)
    # A correction holds until there is a surprise, but where the ground differs.
    again = surprising | (memory.corrected > 0)
    if memory.contexts.shape[-2]:
        again = torch.ones_like(again)
    memory = memory._replace(
        validity=validity,
        losses=losses,
        noise=noise,
        surprises=torch.where(off, 1.0, TRACE * memory.surprises),
        usual=usual.clamp_min(0.0),
    )
    return memory, changed, (changed & again).squeeze(-1)


def settle(table: Table, settings: Settings, memory: Memory, changed: Tensor) -> Memory:
    """Return the memory where no fault is believed, not ``changed`` ``(B, 1)``.

    There no hypothesis can lose against *no fault*, and a delay is kept as far as it is known.
    """
    losses = memory.losses
    no_worse = losses.minimum(losses[..., :1])
    return memory._replace(
        losses=torch.where(changed[..., None], losses, no_worse),
        delay=known_delay(table, settings, memory, changed),
    )


def _with_changing_delay(table: Table, miss: Tensor, loss: Tensor) -> tuple[Tensor, Tensor]:
    """Return misses and losses ``(B, A, H)`` with those of a delay that is another one each step.

    It has those of the constant delay that is best for all axes, and pays for the choice.
    """
    delays = table.constant_delays
    best = delays[loss[..., delays].sum(-2, True).argmin(-1, True)].expand(*loss.shape[:-1], 1)
    choice = math.log(len(delays)) / loss.shape[-2]
    loss = torch.cat([loss, loss.gather(-1, best) + choice], -1)
    return torch.cat([miss, miss.gather(-1, best)], -1), loss


def _within_range(table: Table, settings: Settings, before: Tensor, losses: Tensor) -> Tensor:
    """Return losses ``(B, A, H)`` such that a change can be believed at any step.

    What surprises *no fault* surprises hypotheses that have yet to adapt: one that was right by
    chance leads by the prior odds at most. And none falls behind by more than a change may need
    (fixed share: Herbster and Warmuth 1998, Machine Learning 32); delays by half of it, while all
    axes are healthy.
    """
    odds, nominal = settings.nominal_log_odds, losses[..., :1]
    losses = losses.maximum((nominal - odds) * (before[..., :1] <= odds))
    least = losses.amin(-1, True)
    healthy = (nominal <= least + odds).all(-2, True)
    return losses.minimum(least + torch.where(healthy, table.loss_range, LOSS_RANGE))


def is_changed(settings: Settings, losses: Tensor) -> Tensor:
    """Return whether *no fault* has lost its prior odds on some axis, ``(B, 1)``."""
    return losses[..., 0].amax(-1, True) > settings.nominal_log_odds


def gate(settings: Settings, memory: Memory) -> Tensor:
    """Return up to which innovation a transition needs no explanation, ``(B, 1)``.

    While plans are executed, what is usual; 0 while they are corrected.
    """
    return settings.innovation_gate * (1 - memory.corrected) * memory.usual.exp()


def prior(table: Table, settings: Settings, memory: Memory) -> tuple[Tensor, Tensor, Tensor]:
    """Return prior log-odds ``(B, A, H)``, the weight of a pair in noise, and the least noise.

    Weight and noise are ``(B, A)``; effects nearer than the least noise are all the same.
    """
    largest = torch.linalg.vector_norm(memory.commands, torch.inf, -1)
    floor = LEAST_NOISE * largest.clamp(LEAST_COMMAND, 1.0)
    weight = (floor / memory.noise).square().clamp_max(1.0)
    faults = (weight[..., None] * table.log_prior).log_softmax(-1)
    return pad(faults, (1, 0), value=settings.nominal_log_odds), weight, floor


def beliefs(table: Table, settings: Settings, memory: Memory) -> Tensor:
    r"""Return the probabilities of the hypotheses, ``(B, A, H)``.

    .. math:: w_{ha} \propto \Big(\tfrac12 \pi_h + \tfrac12 \pi_h
              \prod_{b \ne a} e^{-\min(l_{hb} - \min_g l_{gb},\, 7)}\Big)\, e^{-l_{ha}}

    Half of the prior of an axis is what all others together say, for they may share a fault.
    """
    losses, (log_prior, _, _) = memory.losses, prior(table, settings, memory)
    if losses.shape[-2] > 1:
        doubt = (losses - losses.amin(-1, True)).clamp_max(DOUBT)
        of_others = (log_prior - (doubt.sum(-2, True) - doubt)).softmax(-1)
        log_prior = torch.lerp(log_prior.softmax(-1), of_others, SHARED).log()
    return (log_prior - losses).softmax(-1)


def likeliest_delay(table: Table, settings: Settings, memory: Memory) -> Tensor:
    """Return the likeliest delay of all axes together, ``(B, 1)``; the last one has the odds.

    All axes have the same delay, so its prior counts once. A robot is late if all delays together
    are likelier than none; those that no command has outlived yet say nothing.
    """
    log_prior = prior(table, settings, memory)[0]
    before = log_prior.softmax(-1) @ table.has_delay
    ratio = (log_prior - memory.losses).softmax(-1) @ table.has_delay / before
    ratio = (ratio / ratio.amax(-1, True)).clamp_min(1e-3)  # no axis decides alone
    stays = settings.nominal_log_odds * (table.delays == memory.delay)
    score = before.mean(-2).log() + ratio.log().sum(-2) + stays
    outlived = table.delays < (memory.validity > 0).sum(-1, True)
    each = torch.where((table.delays > 0) & outlived, score, -torch.inf)
    late = each.logsumexp(-1, True) > score[..., :1]
    delay = (late * each.argmax(-1, True)).to(score)
    return torch.where(delay > 0, delay, known_delay(table, settings, memory))


def known_delay(
    table: Table, settings: Settings, memory: Memory, held: bool | Tensor = False
) -> Tensor:
    """Return the delay ``(B, 1)`` that is kept until a hypothesis without delay predicts better.

    By the prior odds, over all axes: evidence fades, as a robot at rest tells nothing of its delay.
    Where it is ``held`` ``(B, 1)``, it is kept in any case.
    """
    delay = memory.delay
    if none_holds(delay):
        return delay
    late, without = (
        torch.where(table.delay_of == steps, memory.losses[..., :-1], torch.inf).amin(-1)
        for steps in (delay[..., None], 0)
    )
    return delay * (held | ((late - without).sum(-1, True) <= settings.nominal_log_odds))
