"""The state space of a MuJoCo model."""

from __future__ import annotations

from collections.abc import Sequence

import roma
import torch
from torch import Tensor

from afm_rl.spaces.manifold import Manifold, wrap_angle


class MuJoCoSpace(Manifold):
    r"""Positions, velocities and activations, :math:`(q, \dot q, w)`, with angles and rotations.

    Quaternions are scalar-first in the state, as in MuJoCo, and rotation vectors in the body's
    frame in the tangent space, as in its velocities: ``difference`` agrees with
    ``mj_differentiatePos``.

    Args:
        size: number of state coordinates, S.
        angles: coordinates that wrap at +-pi: hinges without limits.
        quaternions: first coordinate of each quaternion: ball and free joints.

    >>> space = MuJoCoSpace(5, angles=[4], quaternions=[0])
    >>> level = torch.tensor([1.0, 0.0, 0.0, 0.0, 3.0])
    >>> moved = space.add(level, torch.tensor([0.0, 0.0, 0.1, 0.5]))
    >>> space.difference(moved, level)
    tensor([0.0000, 0.0000, 0.1000, 0.5000])
    """

    def __init__(
        self, size: int, angles: Sequence[int] = (), quaternions: Sequence[int] = ()
    ) -> None:
        super().__init__(size, angles)
        self.quaternions = list(quaternions)
        self.tangent_size = size - len(self.quaternions)

    def _parts(self, vector: Tensor, width: int) -> list[Tensor]:
        """Split at the quaternions, each ``width`` wide: plain, turn, plain, turn, ..., plain."""
        sizes, at = [], 0
        for first in self.quaternions:
            sizes += [first - at, width]
            at = first + 4
        return list(vector.split([*sizes, self.size - at], -1))

    def project(self, raw: Tensor) -> Tensor:
        """Scale the quaternions in ``(*B, S)`` to length 1."""
        parts = self._parts(raw, 4)
        parts[1::2] = [roma.quat_normalize(part) for part in parts[1::2]]
        return torch.cat(parts, -1)

    def difference(self, state: Tensor, origin: Tensor) -> Tensor:
        """Return the tangent vector ``(*B, D)`` that leads from ``origin`` to ``state``."""
        raw = state - origin
        raw = torch.where(self.is_angle, wrap_angle(raw), raw)
        if not self.quaternions:
            return raw
        parts = self._parts(raw, 4)
        for k, first in enumerate(self.quaternions):
            here, there = (x[..., first : first + 4].roll(-1, -1) for x in (origin, state))
            turn = roma.quat_product(roma.quat_conjugation(here), there)
            parts[2 * k + 1] = roma.unitquat_to_rotvec(turn)
        return torch.cat(parts, -1)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        """Return the state ``(*B, S)`` reached from ``origin`` along ``tangent``."""
        turns = self._parts(tangent, 3)
        for k, first in enumerate(self.quaternions):
            here = origin[..., first : first + 4].roll(-1, -1)
            turned = roma.quat_product(here, roma.rotvec_to_unitquat(turns[2 * k + 1]))
            turns[2 * k + 1] = turned.roll(1, -1) - origin[..., first : first + 4]
        raw = origin + torch.cat(turns, -1)
        return torch.where(self.is_angle, wrap_angle(raw), raw)
