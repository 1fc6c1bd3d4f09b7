"""The state space of a rigid body.

Quaternions are scalar-last, :math:`q = (q_x, q_y, q_z, q_w)`, and turn vectors of the body frame
into the world frame, as those of ``roma``.
"""

from __future__ import annotations

from collections.abc import Sequence

import roma
import torch
from torch import Tensor

from afm_rl.spaces.manifold import Manifold


class RigidBodySpace(Manifold):
    r"""Rigid-body states: position, velocity, quaternion, body rate; S = 13 and D = 12.

    States are :math:`(r, v, q, \omega)` in m, m/s, 1 and rad/s (body frame); tangent vectors
    :math:`(\Delta r, \Delta v, \phi, \Delta \omega)` hold a rotation vector in rad, in the body
    frame of the origin: :math:`q = q_0 \otimes \exp \phi`.

    >>> space = RigidBodySpace()
    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> turned = space.add(level, torch.full((12,), 0.1))
    >>> space.difference(turned, level).shape, bool(space.difference(level, level).any())
    (torch.Size([12]), False)
    """

    def __init__(self) -> None:
        super().__init__(13)
        self.tangent_size = 12

    def project(self, raw: Tensor) -> Tensor:
        turned = roma.quat_normalize(raw[..., 6:10])
        return torch.cat([raw[..., :6], turned, raw[..., 10:]], -1)

    def encode(self, state: Tensor, coordinates: Sequence[int] | None = None) -> Tensor:
        """Return what a network reads: the rotation matrix's nine entries for the quaternion.

        The other coordinates come first. A quaternion and its negative give the same numbers.
        """
        chosen = range(self.size) if coordinates is None else coordinates
        plain = [i for i in chosen if i not in range(6, 10)]
        if len(plain) == len(chosen):
            return state[..., plain]
        matrix = roma.unitquat_to_rotmat(state[..., 6:10]).mT
        return torch.cat([state[..., plain], matrix.flatten(-2)], -1)

    def difference(self, state: Tensor, origin: Tensor) -> Tensor:
        raw = state - origin
        turn = roma.quat_product(roma.quat_conjugation(origin[..., 6:10]), state[..., 6:10])
        return torch.cat([raw[..., :6], roma.unitquat_to_rotvec(turn), raw[..., 10:]], -1)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        turned = roma.quat_product(origin[..., 6:10], roma.rotvec_to_unitquat(tangent[..., 6:9]))
        moved = origin[..., :6] + tangent[..., :6]
        return torch.cat([moved, turned, origin[..., 10:] + tangent[..., 9:]], -1)
