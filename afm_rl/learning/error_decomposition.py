"""Prediction errors, taken apart: what an action can explain, and what none can."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import ConfigurationError


class ErrorParts(NamedTuple):
    """Transitions in half ranges of the action and standard deviations of the model."""

    effective: Tensor
    """The action that explains the transition best, ``(*B, A)``."""
    weight: Tensor
    """One over the variance of each of its components, ``(*B, A)``."""
    unmatched: Tensor
    """What no action explains of the next state, in standard deviations, ``(*B, D)``."""
    projection: Tensor
    """Onto what no action reaches, ``(*B, D, D)``."""
    noise: Tensor
    """The model's standard deviation, ``(*B, D)``."""


def check_half_range(scale: Sequence[float] | Tensor, size: int) -> Tensor:
    """Return an updater's ``scale``, the half ranges of actions, as ``(A,)``; refuse what is none.

    >>> check_half_range([1.0, 1.5], 2)
    tensor([1.0000, 1.5000])
    """
    values = torch.as_tensor(scale, dtype=torch.get_default_dtype())
    if values.shape != (size,) or not bool(((values > 0) & values.isfinite()).all()):
        raise ConfigurationError(
            f"updater.scale={values.tolist()}: expected {size} positive numbers, the half "
            "range of each action"
        )
    return values


def decompose_error(
    model: DynamicsModel, state: Tensor, action: Tensor, next_state: Tensor, half_range: Tensor
) -> ErrorParts:
    r"""Find the action that explains a transition best, and what it leaves over.

    With v the effective action (:func:`~afm_rl.dynamics.inverse.effective_action`), N the model's
    standard deviations and J the Jacobian by the action, both in these units,

    .. math:: r = (I - J J^+)\, N^{-1} (s_{t+1} \ominus f(s_t, v))

    The search for v begins at the executed action.

    >>> from afm_rl.dynamics import Dubins
    >>> s, u = torch.zeros(3), torch.tensor([0.5, 0.2])
    >>> seen = Dubins()(s, -u) + torch.tensor([0.0, 0.01, 0.0])  # reversed, and pushed aside
    >>> parts = decompose_error(Dubins(), s, u, seen, torch.ones(2))
    >>> parts.effective.round(decimals=3), parts.unmatched.abs().round()
    (tensor([-0.5000, -0.2000]), tensor([ 0., 10.,  0.]))
    """
    half_range = half_range.to(action)
    best = effective_action(model, state, action, next_state, half_range, quiet=-1.0)
    ahead, noise = model.forecast(state, best.action)
    error = model.manifold.difference(next_state, ahead) / noise
    jacobian = (model.jacobian(state, best.action) * half_range / noise.unsqueeze(-1)).double()
    gram = jacobian.mT @ jacobian
    ridge = 1e-6 * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-12)
    gram.diagonal(dim1=-2, dim2=-1).add_(ridge.unsqueeze(-1))
    inverse = torch.linalg.inv_ex(gram).inverse @ jacobian.mT
    matched = jacobian @ inverse
    eye = torch.eye(noise.shape[-1], device=noise.device, dtype=matched.dtype)
    projection = (eye - matched).to(error)
    unmatched = (projection @ error.unsqueeze(-1)).squeeze(-1)
    weight = best.std.reciprocal().square()
    effective = best.action / half_range
    if model.affine:  # exact but for the prior: undo its small pull towards the executed action
        effective = effective + (inverse @ error.unsqueeze(-1).double()).squeeze(-1).to(action)
    return ErrorParts(effective, weight, unmatched, projection, noise)
