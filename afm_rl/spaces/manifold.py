"""State spaces on which differences are taken: R^n with angles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_count


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
        outside = [i for i in angles if not 0 <= i < size]
        if outside:
            raise ConfigurationError(f"manifold.angles={list(angles)}: expected 0..{size - 1}")
        mask = torch.zeros(size, dtype=torch.bool)
        mask[list(angles)] = True
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
        raw = state - origin
        return torch.where(self.is_angle, wrap_angle(raw), raw)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        """Return the state ``(*B, S)`` reached from ``origin`` along ``tangent``."""
        raw = origin + tangent
        return torch.where(self.is_angle, wrap_angle(raw), raw)
