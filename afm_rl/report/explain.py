"""The action that explains a displacement."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel, effective_action

Box = tuple[Tensor, Tensor]


def explain(model: DynamicsModel, state: Tensor, change: Tensor, box: Box) -> tuple[Tensor, Tensor]:
    """Return the actions of a box with which a model comes near to given displacements.

    The effective action (:func:`~afm_rl.dynamics.effective_action`) of the displacement, clipped.

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
    middle = ((low + high) / 2).expand(*change.shape[:-1], len(low))
    reached = model.manifold.add(state, change)
    action = effective_action(model, state, middle, reached, (high - low) / 2).action
    action = torch.minimum(torch.maximum(action, low), high)
    rest = change - model.manifold.difference(model(state, action), state)
    return action, rest.norm(dim=-1)
