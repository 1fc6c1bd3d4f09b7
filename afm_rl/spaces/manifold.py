"""State spaces on which differences are taken: R^n with angles, rigid bodies; draws of points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import roma
import torch
from torch import Tensor, nn

from afm_rl.errors import check_count, check_indices


def wrap_angle(angle: Tensor) -> Tensor:
    """Map an angle in rad to [-pi, pi).

    >>> wrap_angle(torch.tensor(4.0))
    tensor(-2.2832)
    """
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


class Manifold(nn.Module):
    r"""R^n in which some coordinates are angles (R^2 x S^1 for a ground robot).

    ``difference`` is the paper's :math:`\ominus`, ``add`` its inverse:
    ``add(s, difference(t, s)) == t``. Other spaces (rotations) subclass this and may have a
    ``tangent_size`` smaller than ``size``.

    Args:
        size: number of coordinates of a state, S.
        angles: indices of the coordinates that wrap at +-pi.

    >>> space = Manifold(3, angles=[2])
    >>> east, west = torch.tensor([0.0, 0.0, 3.1]), torch.tensor([0.0, 0.0, -3.1])
    >>> space.difference(west, east)[2] < 0.1
    tensor(True)
    """

    is_angle: Tensor

    def __init__(self, size: int, angles: Sequence[int] = ()) -> None:
        super().__init__()
        self.size = check_count("manifold.size", size)
        self.tangent_size = self.size
        mask = torch.zeros(size, dtype=torch.bool)
        mask[check_indices("manifold.angles", angles, size)] = True
        self.register_buffer("is_angle", mask, persistent=False)
        self._turning = frozenset(mask.nonzero().flatten().tolist())  # no look at the device

    def project(self, raw: Tensor) -> Tensor:
        """Return the states ``(*B, S)`` that numbers drawn from a box stand for: themselves."""
        return raw

    def encode(self, state: Tensor, coordinates: Sequence[int] | None = None) -> Tensor:
        """Return the numbers ``(*B, F)`` that a network reads: they do not jump where angles wrap.

        Coordinates that are no angles come first, as they are, then the cosines and the sines of
        the angles.

        Args:
            state: ``(*B, S)``.
            coordinates: indices of the coordinates to encode; None for all.

        >>> turned = torch.tensor([5.0, torch.pi])
        >>> Manifold(2, angles=[1]).encode(turned).round(decimals=4) + 0.0
        tensor([ 5., -1.,  0.])
        """
        chosen = range(self.size) if coordinates is None else coordinates
        plain, angles = ([i for i in chosen if (i in self._turning) == turns] for turns in (0, 1))
        angle = state[..., angles]
        return torch.cat([state[..., plain], angle.cos(), angle.sin()], -1)

    def difference(self, state: Tensor, origin: Tensor) -> Tensor:
        """Return the tangent vector ``(*B, D)`` that leads from ``origin`` to ``state``."""
        return self._wrapped(state - origin)

    def subtract(self, state: Tensor, origin: Tensor) -> Tensor:
        """Subtract coordinates ``(*B, S)``, angles by the shorter way, rotations as numbers."""
        return self._wrapped(state - origin)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        """Return the state ``(*B, S)`` reached from ``origin`` along ``tangent``."""
        return self._wrapped(origin + tangent)

    def _wrapped(self, raw: Tensor) -> Tensor:
        return torch.where(self.is_angle, wrap_angle(raw), raw) if self._turning else raw


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


def uniform(low: Tensor, high: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` points uniformly in a box: ``(count, D)``.

    >>> uniform(torch.zeros(2), torch.ones(2), 5, torch.Generator()).shape
    torch.Size([5, 2])
    """
    share = torch.rand(count, len(low), generator=generator)  # the same on every device
    return low + (high - low) * share.to(low.device)


def draw_states(
    states: tuple[Tensor, Tensor] | Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Draw ``count`` states from a box or, with replacement, from a pool: ``(count, S)``.

    Args:
        states: lowest and highest state, ``(S,)`` each; or observed states, ``(P, S)``.
        count: how many.
        generator: of the numbers.

    >>> draw_states(torch.tensor([[7.0, 8.0]]), 2, torch.Generator()).tolist()
    [[7.0, 8.0], [7.0, 8.0]]
    """
    if isinstance(states, Tensor):
        return states[torch.randint(len(states), (count,), generator=generator).to(states.device)]
    return uniform(*states, count, generator)
