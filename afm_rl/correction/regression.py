"""Bayesian linear regression of all rows of the table, from one Gram matrix per weighting."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from afm_rl.correction.belief import visible
from afm_rl.correction.records import Memory, Plan
from afm_rl.correction.table import FREE, Table
from afm_rl.spaces.small_matrices import invert_positive

LEAST_VARIANCE = 1e-4  # of a pair, shares of the largest action, squared
LONGEST_LAG = 64  # commands, after which nothing is left of an effect
UNKNOWN = 1e6  # squared distance to a pair whose effect is not known


class Evidence(NamedTuple):
    """The pairs that are remembered, as inputs and outputs of the regression."""

    features: Tensor
    """Of the M pairs, and of what acts now, with a present command of 0, ``(B, A, M + 1, F)``."""
    effects: Tensor
    """What the model sees of them, ``(B, A, M)``."""
    weights: Tensor
    """By age, or by distance in the context coordinates, ``(B, A, G, M)``."""
    precision: Tensor
    """Of the pair with the largest weight, ``(B, A, 1)``."""
    commands: Tensor
    """What the model sees of the commands of the pairs, ``(B, A, M)``."""
    since: Tensor
    """Are pairs from after the change? ``(B, 1, M)``."""
    weight: Tensor
    """Of the pairs since the change, ``(B, A, 1, M)``."""
    queue: Tensor | None
    """What the model sees of commands that are known to act later, ``(B, A, 1, D)``."""
    hidden: Tensor | None
    """What it does not see of commands, I - P, ``(B, A, A)``; None: nothing."""


class Fits(NamedTuple):
    """The posterior of every row, and of the maps that mix actuators."""

    coefficients: Tensor
    r""":math:`\theta`, ``(B, A, R, W)``."""
    now: Tensor
    """Features of what acts now, as far as they do not depend on it, ``(B, A, F)``."""
    curves: Tensor
    """Coefficients of the basis of the command that is sent now, once it acts, ``(B, A, R, P)``."""
    covariance: Tensor
    """Of these, in variances of the noise, ``(B, A, R, P, P)``."""
    maps: Tensor | None
    """(D, b) of an affine map, and of two swapped axes, ``(B, A, 2, A + 1)``; None: one axis."""
    map_covariance: Tensor | None
    """Of each row of the affine map, ``(B, A, A + 1, A + 1)``."""
    hidden: Tensor | None
    """I - P: what the model does not see of commands, ``(B, A, A)``; None: it sees all of them."""


def evidence_of(table: Table, memory: Memory, plan: Plan, hidden: Tensor | None = None) -> Evidence:
    """Return the pairs of a memory as inputs and outputs of the regression.

    Of commands and effects, as far as the model sees them: not what is ``hidden``.
    """
    sure = (memory.stds.square() + (memory.noise.square() + LEAST_VARIANCE)[..., None]).reciprocal()
    validity = memory.validity[..., None, :]
    since, known = validity == 1.0, validity > 0
    weight = since * sure
    precision = weight.amax(-1, True).clamp_min(LEAST_VARIANCE)
    weight = (weight / precision)[..., None, :]
    weights = weight * table.decay
    if plan.context is not None:  # against the nearest pair
        last = memory.contexts[..., -1]  # where there is no reading
        here = torch.where(plan.context.isfinite(), plan.context, last)[..., None]
        distance = (memory.contexts - here).square().sum(-2)
        distance = torch.where(known[..., 0, :], distance + table.distance_of_age, UNKNOWN)
        excess = (distance.amin(-1, True) - distance).clamp_min(-1e3)[..., None, :]
        near = (excess * table.nearness).exp()[..., None, :, :]
        near = (known * sure / precision)[..., None, :] * near
        weights = torch.cat([weights, near], -2)
    queue = None
    if plan.queue is not None:
        queue = visible(hidden, plan.queue[..., -LONGEST_LAG:])[..., None, :]
    sent, v = visible(hidden, memory.commands), visible(hidden, memory.effects)
    x = features(table, sent, v, since, known)
    return Evidence(x, v, weights, precision, sent, since, weight, queue, hidden)


def features(table: Table, sent: Tensor, v: Tensor, since: Tensor, known: Tensor) -> Tensor:
    """Return the features ``(B, A, M + 1, F)``, in the order of the table.

    Args:
        table: of hypotheses.
        sent: commands of the pairs, ``(B, A, M)``.
        v: effects, ``(B, A, M)``.
        since: are pairs from after the change? ``(B, 1, M)``.
        known: is their effect known at all? ``(B, 1, M)``.
    """
    u = pad(sent, (0, 1))  # and what acts now
    lagged = pad(u, (table.max_delay, 0))[..., table.lags]
    miss = (v - sent) * since
    effect = pad(torch.where(known, v, sent), (1, 0)) - u
    first = pad(miss, (1, 0))
    second = torch.where(pad(since, (2, -1)), pad(miss, (2, -1)), first)
    past = torch.stack([effect, first, second, miss @ table.smoothing, u * table.age], -1)
    return torch.cat([lagged, past, table.basis(u[..., None, :])[..., 1:, :].mT], -1)


def fit(table: Table, memory: Memory, evidence: Evidence) -> Fits:
    r"""Return the posterior of every row.

    .. math:: \Sigma = \Big(\sum_k w_k x_k x_k^\top + \Lambda\Big)^{-1},\qquad
              \theta = m + \Sigma \sum_k w_k x_k (v_k - m^\top x_k)

    Each row is a block of one Gram matrix of all features, in its weighting.
    """
    x, precision = evidence.features, evidence.precision
    xv = torch.cat([x[..., :-1, :], evidence.effects[..., None]], -1)[..., None, :, :]
    gram = (evidence.weights[..., None] * xv).mT @ xv  # (B, A, G, F + 1, F + 1)
    block = gram[..., table.group, table.row_index, table.column_index]  # (B, A, R, W, W + 1)
    if table.mixes:  # one regression for all axes, each by how sure it is
        share = (precision / precision.amax(-2, True))[..., None, None]
        block = torch.where(table.shared, (block * share).sum(-4, True), block)
    covariance = invert_positive(block[..., :-1] + table.precision)
    theta = table.mean + (covariance @ (block @ table.mean_of_error)).squeeze(-1)
    # The last coefficient within its bounds, and the others given that.
    last, column = theta[..., -1:], covariance[..., -1]
    outside = last.clamp(table.low, table.high) - last
    theta = theta + column * (outside / column[..., -1:])
    # Each row as a function of the present command: theta . (what it adds + what is known of x).
    now = x[..., -1, :] * table.known
    inputs = _inputs(table, now[..., table.index])
    if evidence.queue is not None:  # an actuator with a lag keeps a share of the queue's effect
        inputs = _inputs_after(table, evidence.queue, now, theta)
    curves = (inputs @ theta[..., None]).squeeze(-1)
    covariance = inputs @ covariance @ inputs.mT
    maps = _maps(table, memory, evidence)
    return Fits(theta, now, curves, covariance, *maps, evidence.hidden)


def _inputs(table: Table, past: Tensor) -> Tensor:
    """Return what features are in terms of the basis, ``(B, A, R, P, W)``."""
    past = (past * table.of_past)[..., None, :]
    return table.of_command + pad(past, (0, 0, table.of_command.shape[-2] - 1, 0))


def _inputs_after(table: Table, queue: Tensor, now: Tensor, theta: Tensor) -> Tensor:
    """Return these after a queue of commands ``(B, A, 1, D)``, by each row's own forecasts."""
    past = torch.where(table.is_effect, 0.0, now[..., table.index])
    forced = (_inputs(table, past) @ theta[..., None]).squeeze(-1) @ table.basis(queue)
    keeps = (table.is_effect * theta).sum(-1)
    effect = now[..., table.effect]
    for k in range(queue.shape[-1]):
        effect = forced[..., k] + keeps * effect
    return _inputs(table, torch.where(table.is_effect, effect[..., None], past))


def _maps(table: Table, memory: Memory, evidence: Evidence) -> tuple[Tensor | None, Tensor | None]:
    """Return the maps that mix actuators: an affine one, and each axis swapped with another."""
    if not table.mixes:
        return None, None
    inputs = pad(memory.commands, (0, 0, 0, 1), value=1.0)[..., None, :, :]  # (B, 1, A + 1, M)
    weighted = evidence.weight * inputs
    gram, pull = weighted @ inputs.mT, (weighted @ evidence.effects[..., None]).squeeze(-1)
    covariance = invert_positive(gram + table.affine_precision)
    seen = table.eye if evidence.hidden is None else table.eye - pad(evidence.hidden, (0, 1))
    affine = (covariance @ (pull + FREE * seen)[..., None]).squeeze(-1)
    # Axes are swapped with those whose commands explain their effects, if it is mutual.
    miss = (gram.diagonal(dim1=-2, dim2=-1) - 2 * pull)[..., :-1]
    miss = miss + torch.linalg.vecdot(evidence.weight, evidence.effects.square()[..., None, :])
    partner = (miss + miss.mT).argmin(-1)
    partner = torch.where(partner.gather(-1, partner) == table.axis, partner, table.axis)
    return torch.stack([affine, table.eye[partner]], -2), covariance
