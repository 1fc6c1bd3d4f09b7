"""What an executed action turned out to be worth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel

RIDGE = 1e-6  # relative: lets an action axis without any influence stay where it is


class Evidence(NamedTuple):
    """A transition seen through a model."""

    effective: Tensor
    """Effective action, ``(*B, A)``."""
    surprise: Tensor
    """Largest error over coordinates, in the model's standard deviations, ``(*B)``."""


def effective_action(
    model: DynamicsModel,
    state: Tensor,
    action: Tensor,
    next_state: Tensor,
    half_range: Tensor,
) -> Evidence:
    r"""Express a prediction error in action space, for any model and robot.

    .. math:: a_\mathrm{eff} = a + J^+ e,\qquad e = s_{t+1} \ominus f(s_t, a),\qquad
              J = \partial f / \partial a,

    the pseudo-inverse taken in units of the model's noise (rows) and half ranges (columns).

    Args:
        model: f, as it is now.
        state: ``(*B, S)``.
        action: the action that was executed, ``(*B, A)``.
        next_state: the realised next state, ``(*B, S)``.
        half_range: half ranges of the action box, ``(A,)``.

    >>> from afm_rl.dynamics import Dubins
    >>> s, a = torch.zeros(3), torch.tensor([0.5, 0.2])
    >>> seen = Dubins()(s, -a)  # both motors reversed
    >>> effective_action(Dubins(), s, a, seen, torch.ones(2)).effective
    tensor([-0.5000, -0.2000])
    """
    expected, noise = model.forecast(state, action)
    error = model.manifold.difference(next_state, expected) / noise
    jacobian = model.jacobian(state, action) * half_range / noise.unsqueeze(-1)
    gram = jacobian.mT @ jacobian
    ridge = RIDGE * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-12)
    eye = torch.eye(len(half_range), device=gram.device, dtype=gram.dtype)
    moment = jacobian.mT @ error.unsqueeze(-1)
    step = torch.linalg.solve(gram + ridge[..., None, None] * eye, moment)
    return Evidence(action + step.squeeze(-1) * half_range, error.abs().amax(-1))
