"""The frame of a rigid body, in which what is wrong with its motors or its mass stays put."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.spaces.rotations import rotate, rotate_slope

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
    axes, whole = (torch.eye(size, dtype=state.dtype, device=state.device) for size in (3, 13))
    turned = rotate(state[..., ATTITUDE].unsqueeze(-2), axes).mT
    matrix = whole.repeat(*state.shape[:-1], 1, 1)
    matrix[..., VELOCITY, VELOCITY] = turned
    return matrix


def to_world_slope(state: Tensor, rate: Tensor) -> Tensor:
    """Return how a rate ``(*B, 13)``, turned, changes with the state, ``(*B, 13, 13)``."""
    slope = state.new_zeros(*state.shape, state.shape[-1])
    slope[..., VELOCITY, ATTITUDE] = rotate_slope(state[..., ATTITUDE], rate[..., VELOCITY])
    return slope
