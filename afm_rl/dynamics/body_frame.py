"""The frame of a rigid body, in which what is wrong with its motors or its mass stays put."""

from __future__ import annotations

import roma
import torch
from torch import Tensor

VELOCITY, ATTITUDE = slice(3, 6), slice(6, 10)  # of a state, see RigidBodySpace


def to_world(state: Tensor) -> Tensor:
    r"""Return what turns a rate of change whose acceleration is along the body's axes.

    Args:
        state: position, velocity, quaternion (scalar-last) and body rate, ``(*B, 13)``.

    Returns:
        The matrix ``(*B, 13, 13)``: :math:`R(q)` for the velocity, 1 for all else.

    >>> quarter = torch.zeros(13).index_fill(0, torch.tensor([8, 9]), 0.5**0.5)  # about z
    >>> (to_world(quarter) @ torch.arange(13.0))[3:6].round()
    tensor([-4.,  3.,  5.])
    """
    whole = torch.eye(13, dtype=state.dtype, device=state.device)
    matrix = whole.repeat(*state.shape[:-1], 1, 1)
    matrix[..., VELOCITY, VELOCITY] = roma.unitquat_to_rotmat(state[..., ATTITUDE])
    return matrix


def to_world_slope(state: Tensor, rate: Tensor) -> Tensor:
    r"""Return how a rate ``(*B, 13)``, turned, changes with the state, ``(*B, 13, 13)``.

    :math:`\mathrm d(q \otimes a \otimes \bar q) = 2\,\mathrm{vec}(\mathrm dq \otimes a \otimes
    \bar q)` for the acceleration a.
    """
    push = torch.nn.functional.pad(rate[..., VELOCITY], (0, 1)).unsqueeze(-2)
    back = roma.quat_conjugation(state[..., ATTITUDE]).unsqueeze(-2)
    steps = torch.eye(4, dtype=state.dtype, device=state.device)
    slope = state.new_zeros(*state.shape, state.shape[-1])
    turned = roma.quat_product(steps, roma.quat_product(push, back))
    slope[..., VELOCITY, ATTITUDE] = 2 * turned[..., :3].mT
    return slope
