"""How probable each delay of commands is, and which commands act now."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold


def delay_tables(delays: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return likelihood and log prior of each delay, given the present estimate.

    The likelihood is linear in the models' probabilities: :math:`1 / p_k` for the models with a
    delay of k steps, whose prior is :math:`p_k`.

    No delay, k = 0, is as probable, a priori, as all models without one; *nothing has changed*
    counts among them no more than the others together. An estimate stays, as actuators' delays do,
    until the evidence for another one exceeds the odds of *nothing has changed*. No delay is not
    favoured so: a robot whose commands act eight steps late falls before there is much evidence.

    Args:
        delays: of the M models, the first of which is *nothing has changed*; -1: they take any.
        prior: log-odds of the models, ``(M,)``.

    Returns:
        Both for every present estimate, ``(K + 1, K + 1, M)`` and ``(K + 1, K + 1)``.

    >>> likelihood, log_prior = delay_tables(torch.tensor([0, -1, 1]), torch.zeros(3))
    >>> likelihood[0]
    tensor([[1.5000, 1.5000, 0.0000],
            [0.0000, 0.0000, 3.0000]])
    """
    estimates = torch.arange(int(delays.max()) + 1)
    of_models = torch.where(delays < 0, estimates.unsqueeze(-1), delays).unsqueeze(1)
    has_delay = (of_models == estimates.unsqueeze(-1)).to(prior)  # (K + 1, K + 1, M)
    share = prior.softmax(0)
    undelayed = share[1:][delays[1:] <= 0].sum()
    has_delay[..., 0] *= (undelayed / share[0]).clamp_max(1.0)
    mass = has_delay @ share
    likelihood, mass = has_delay / mass.unsqueeze(-1), mass / mass.sum(-1, keepdim=True)
    stays = torch.lerp(mass[1:], torch.eye(len(estimates))[1:], share[0])
    return likelihood, torch.cat([mass[:1], stays]).log()


def likeliest_delay(
    weights: Tensor, before: Tensor, likelihood: Tensor, log_prior: Tensor
) -> Tensor:
    r"""Return the most probable delay of commands in steps, ``(*B)``.

    .. math:: k = \operatorname{argmax}_k \log p_k + \sum_a \log\frac{p_{ka}}{p_k}

    One for all axes, from the evidence of all: an axis whose commands hardly change shows none.

    Args:
        weights: probabilities of the models on every axis, ``(*B, M, A)``.
        before: the present estimate, ``(*B)``.
        likelihood: of :func:`delay_tables`.
        log_prior: likewise.

    >>> weights = torch.tensor([[0.1, 0.1], [0.1, 0.1], [0.8, 0.8]])
    >>> tables = delay_tables(torch.tensor([0, -1, 1]), torch.zeros(3))
    >>> likeliest_delay(weights, torch.tensor(0), *tables)
    tensor(1)
    """
    evidence = likelihood[before].to(weights) @ weights  # (*B, K + 1, A)
    # No axis decides alone: on each, every delay keeps a thousandth of the best.
    evidence = (evidence / evidence.amax(-2, keepdim=True)).clamp_min(1e-3).log()
    return (log_prior[before].to(weights) + evidence.sum(-1)).argmax(-1)


def command_acting(commands: Tensor, delay: Tensor) -> Tensor:
    """Return the command ``(*B, A)`` that acts now, of all ``(*B, N, A)``, the newest last."""
    row = (commands.shape[-2] - 1 - delay)[..., None, None]
    return commands.gather(-2, row.expand(*row.shape[:-1], commands.shape[-1])).squeeze(-2)


def align(pairs: Tensor, delay: Tensor, size: int) -> Tensor:
    """Return pairs ``(*B, M, D)`` with the commands of ``delay`` ``(*B)`` steps before each effect.

    >>> pairs = torch.tensor([[0.1, 7.0, 0.0, 1.0], [0.2, 8.0, 0.0, 1.0]])
    >>> align(pairs, torch.tensor(1), 1)[..., [0, 3]]
    tensor([[0.1000, 0.0000],
            [0.1000, 1.0000]])
    """
    if all_hold(delay == 0):
        return pairs
    row = torch.arange(pairs.shape[-2], device=pairs.device) - delay.unsqueeze(-1)
    sent = pairs[..., :size]
    sent = sent.gather(-2, row.clamp_min(0).unsqueeze(-1).expand_as(sent))
    valid = pairs[..., 3 * size :][..., :1] * (row >= 0).unsqueeze(-1)
    return torch.cat([sent, pairs[..., size : 3 * size], valid, pairs[..., 3 * size + 1 :]], -1)
