"""What a reference flight is: where to be, and how fast, at any time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_instance


class Reference(ABC):
    """Position and velocity over time.

    References made of points that are far from zero are moved by whole kilometres, so that single
    precision does: see :func:`~afm_rl.envs.courses.track.local_origin`.

    Attributes:
        name: how missions call it.
    """

    name: str

    @abstractmethod
    def at(self, time: Tensor) -> Tensor:
        """Return position (m) and velocity (m/s) ``(*B, 6)`` at times (s) ``(*B)``."""


def check_reference(reference: Reference) -> Reference:
    """Return a reference if it gives positions and velocities.

    Raises:
        ConfigurationError: otherwise.
    """
    size = tuple(check_instance("tracks", reference, Reference).at(torch.zeros(2)).shape)
    if size != (2, 6):
        raise ConfigurationError(
            f"tracks: {reference.name}: at() gives {size} for 2 times, expected (2, 6): position "
            "and velocity"
        )
    return reference


def references_at(references: Sequence[Reference], index: Tensor, time: Tensor) -> Tensor:
    """Return positions and velocities ``(*B, K, 6)`` of flights that follow several references.

    Args:
        references: the references.
        index: which one each flight follows, ``(*B)``.
        time: times (s), ``(*B, K)``.

    >>> from afm_rl.envs import Hover
    >>> flights = torch.tensor([0, 1])
    >>> references_at([Hover(), Hover([0, 0, 1])], flights, torch.zeros(2, 3))[..., 2]
    tensor([[0., 0., 0.],
            [1., 1., 1.]])
    """
    if len(references) == 1:
        return references[0].at(time)
    every = torch.stack([reference.at(time) for reference in references])
    chosen = index[None, ..., None, None].expand(1, *every.shape[1:])
    return every.gather(0, chosen).squeeze(0)
