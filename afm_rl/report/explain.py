"""Which action would have done the same."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel

ROUNDS = 10
Box = tuple[Tensor, Tensor]


def explain(model: DynamicsModel, state: Tensor, change: Tensor, box: Box) -> tuple[Tensor, Tensor]:
    r"""Return the actions with which a model comes nearest to given displacements.

    Projected Gauss-Newton: :math:`a \leftarrow \mathrm{clamp}(a + J^+ (\Delta - f(s, a) + s))`.

    Args:
        model: the base model.
        state: ``(*B, S)``.
        change: displacements on the state's manifold, ``(*B, D)``.
        box: lowest and highest action, ``(A,)`` each.

    Returns:
        Actions ``(*B, A)``, and how far the displacements remain from them, ``(*B)``, in the
        units of the state.

    >>> from afm_rl.dynamics import Dubins
    >>> box = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> action, rest = explain(Dubins(), torch.zeros(3), torch.tensor([-0.1, 0.0, 0.2]), box)
    >>> action, bool(rest < 1e-6)
    (tensor([-0.5000,  1.0000]), True)
    """
    low, high = box
    action = ((low + high) / 2).expand(*change.shape[:-1], len(low))
    for _ in range(ROUNDS):
        miss = change - model.manifold.difference(model(state, action), state)
        step = torch.linalg.pinv(model.jacobian(state, action)) @ miss.unsqueeze(-1)
        action = torch.minimum(torch.maximum(action + step.squeeze(-1), low), high)
    rest = change - model.manifold.difference(model(state, action), state)
    return action, rest.norm(dim=-1)
