"""Rotations as unit quaternions, and the state space of a rigid body.

Quaternions are scalar-last, :math:`q = (q_x, q_y, q_z, q_w)`, and turn vectors of the body frame
into the world frame. All functions are batched, differentiable in both modes, also at the
identity, and keep float32 and float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.spaces.manifold import Manifold

SMALL = 1e-6  # squared angle below which a series is exact to the last digit of a float64


def quaternion_normalise(quaternion: Tensor) -> Tensor:
    """Scale quaternions ``(*B, 4)`` to length 1.

    >>> quaternion_normalise(torch.tensor([0.0, 0.0, 0.0, 2.0]))
    tensor([0., 0., 0., 1.])
    """
    return quaternion / quaternion.square().sum(-1, keepdim=True).sqrt()


def quaternion_conjugate(quaternion: Tensor) -> Tensor:
    """Return the opposite rotations ``(*B, 4)``.

    >>> quaternion_conjugate(torch.tensor([0.6, 0.0, 0.0, 0.8]))
    tensor([-0.6000, -0.0000, -0.0000,  0.8000])
    """
    return torch.cat([-quaternion[..., :3], quaternion[..., 3:]], -1)


def quaternion_multiply(first: Tensor, second: Tensor) -> Tensor:
    r"""Return the products ``(*B, 4)``: ``second`` in the body frame of ``first``.

    .. math:: p \otimes q = (p_w \vec q + q_w \vec p + \vec p \times \vec q,\;
              p_w q_w - \vec p \cdot \vec q)

    >>> half_turn = torch.tensor([1.0, 0.0, 0.0, 0.0])
    >>> quaternion_multiply(half_turn, half_turn)
    tensor([ 0.,  0.,  0., -1.])
    """
    first, second = torch.broadcast_tensors(first, second)
    (u, p), (v, q) = ((x[..., :3], x[..., 3:]) for x in (first, second))
    vector = p * v + q * u + torch.linalg.cross(u, v)
    return torch.cat([vector, p * q - (u * v).sum(-1, keepdim=True)], -1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    r"""Turn body vectors ``(*B, 3)`` into the world frame.

    .. math:: R(q) x = x + 2 q_w (\vec q \times x) + 2\,\vec q \times (\vec q \times x)

    >>> quarter = torch.tensor([0.0, 0.0, 0.5**0.5, 0.5**0.5])  # about z
    >>> rotate(quarter, torch.tensor([1.0, 0.0, 0.0])).round(decimals=4)
    tensor([0., 1., 0.])
    """
    axis, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    across = 2 * torch.linalg.cross(axis, vector)
    return vector + quaternion[..., 3:] * across + torch.linalg.cross(axis, across)


def rotate_slope(quaternion: Tensor, vector: Tensor) -> Tensor:
    r"""Return the derivative of :func:`rotate` by the quaternion's four numbers, ``(*B, 3, 4)``.

    .. math:: \partial R(q) x = [\,2 (\vec q \cdot x) I + 2 \vec q x^\top - 4 x \vec q^\top
              - 2 q_w [x]_\times,\; 2\,\vec q \times x\,]

    >>> rotate_slope(torch.tensor([0.0, 0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 1.0]))
    tensor([[ 0.,  2.,  0.,  0.],
            [-2.,  0.,  0.,  0.],
            [ 0.,  0.,  0.,  0.]])
    """
    axis, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    outer = axis.unsqueeze(-1) * vector.unsqueeze(-2)
    inner = (axis * vector).sum(-1)[..., None, None]
    axes = eye.expand_as(outer)
    across = torch.linalg.cross(vector.unsqueeze(-2).expand_as(axes), axes).mT  # [x] times
    by_axis = 2 * (inner * eye + outer) - 4 * outer.mT - 2 * quaternion[..., 3:, None] * across
    return torch.cat([by_axis, 2 * torch.linalg.cross(axis, vector).unsqueeze(-1)], -1)


def body_z_axis(quaternion: Tensor) -> Tensor:
    r"""Return the body's z axis in the world frame ``(*B, 3)``.

    .. math:: b_3 = (2 (q_x q_z + q_y q_w),\; 2 (q_y q_z - q_x q_w),\; 1 - 2 (q_x^2 + q_y^2))

    >>> body_z_axis(torch.tensor([1.0, 0.0, 0.0, 0.0]))
    tensor([ 0.,  0., -1.])
    """
    x, y, z, w = quaternion.unbind(-1)
    return torch.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], -1)


def quaternion_log(quaternion: Tensor) -> Tensor:
    r"""Return rotation vectors ``(*B, 3)`` in rad, of at most half a turn.

    .. math:: \log q = 2\,\mathrm{atan2}(|\vec q|, q_w)\,\vec q / |\vec q|

    Of q and -q, which are the same rotation, the one with :math:`q_w \ge 0` is taken.

    >>> quaternion_log(-torch.tensor([0.0, 0.0, 0.5**0.5, 0.5**0.5]))
    tensor([0.0000, 0.0000, 1.5708])
    """
    aligned = torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    vector, scalar = aligned[..., :3], aligned[..., 3:]
    square = vector.square().sum(-1, keepdim=True)
    small = square < SMALL
    # The branch that is not taken must not divide by zero either: its gradient would be NaN.
    size = torch.where(small, 1.0, square).sqrt()
    near = torch.where(small, scalar, 1.0)
    ratio = square / near.square()
    series = (2 - ratio * (2 / 3 - ratio * 2 / 5)) / near
    return vector * torch.where(small, series, 2 * torch.atan2(size, scalar) / size)


def quaternion_exp(rotation: Tensor) -> Tensor:
    r"""Return the quaternions ``(*B, 4)`` of rotation vectors ``(*B, 3)`` in rad.

    .. math:: \exp \phi = (\sin(|\phi| / 2)\,\phi / |\phi|,\; \cos(|\phi| / 2))

    >>> quaternion_exp(torch.tensor([0.0, 0.0, torch.pi]))
    tensor([ 0.0000e+00,  0.0000e+00,  1.0000e+00, -4.3711e-08])
    """
    square = rotation.square().sum(-1, keepdim=True)
    small = square < SMALL
    half = torch.where(small, 1.0, square).sqrt() / 2
    quarter = square / 4
    sine = torch.where(small, 0.5 - quarter * (1 / 12 - quarter / 240), half.sin() / (2 * half))
    cosine = torch.where(small, 1 - quarter * (0.5 - quarter / 24), half.cos())
    return torch.cat([rotation * sine, cosine], -1)


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
        turned = quaternion_normalise(raw[..., 6:10])
        return torch.cat([raw[..., :6], turned, raw[..., 10:]], -1)

    def encode(self, state: Tensor, coordinates: Sequence[int] | None = None) -> Tensor:
        """Return what a network reads: the rotation matrix's nine entries for the quaternion.

        The other coordinates come first. A quaternion and its negative give the same numbers.
        """
        chosen = range(self.size) if coordinates is None else coordinates
        plain = [i for i in chosen if i not in range(6, 10)]
        if len(plain) == len(chosen):
            return state[..., plain]
        axes = torch.eye(3, dtype=state.dtype, device=state.device)
        matrix = rotate(state[..., None, 6:10], axes.expand(*state.shape[:-1], 3, 3))
        return torch.cat([state[..., plain], matrix.flatten(-2)], -1)

    def difference(self, state: Tensor, origin: Tensor) -> Tensor:
        raw = state - origin
        turn = quaternion_multiply(quaternion_conjugate(origin[..., 6:10]), state[..., 6:10])
        return torch.cat([raw[..., :6], quaternion_log(turn), raw[..., 10:]], -1)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        turned = quaternion_multiply(origin[..., 6:10], quaternion_exp(tangent[..., 6:9]))
        moved = origin[..., :6] + tangent[..., :6]
        return torch.cat([moved, turned, origin[..., 10:] + tangent[..., 9:]], -1)
