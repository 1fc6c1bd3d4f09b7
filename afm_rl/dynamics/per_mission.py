"""Models of which every mission can have its own."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch import Tensor, nn

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold

Self = TypeVar("Self", bound="PerMissionModel")


class PerMissionModel(DynamicsModel):
    """A dynamics model whose parameters can have a leading dimension of missions.

    Subclasses name these parameters and buffers in :meth:`_owned`.

    :attr:`missions` holds the numbers of the missions that are left, ``(l)``; () while all share
    one model. Whoever remembers something of single missions compares it with this.
    """

    missions: Tensor

    def __init__(self, manifold: Manifold, action_size: int) -> None:
        super().__init__(manifold, action_size)
        self.register_buffer("missions", torch.zeros((), dtype=torch.int64), persistent=False)

    @property
    def lead(self) -> torch.Size:
        return self.missions.shape

    @abstractmethod
    def _owned(self) -> Iterable[tuple[nn.Module, str]]:
        """Return the parameters and buffers of missions: the module and the name in it."""

    def expand_(self: Self, missions: int) -> Self:
        if self.lead:
            raise ConfigurationError(f"dynamics: already expanded to {tuple(self.lead)} missions")
        self._replace_owned(lambda part: part.expand(missions, *part.shape).clone())
        self.missions = torch.arange(missions, device=self.missions.device)
        return self

    def select_(self: Self, index: Tensor) -> Self:
        """Keep the missions in ``index``, in place; a shared model stays as it is."""
        if self.lead:
            self._replace_owned(lambda part: part[index])
            self.missions = self.missions[index]
        return self

    def _replace_owned(self, change: Callable[[Tensor], Tensor]) -> None:
        for owner, name in self._owned():
            part = getattr(owner, name)
            if isinstance(part, nn.Parameter):  # optimisers hold it: only its data may change
                part.data, part.grad = change(part.data), None
            else:
                setattr(owner, name, change(part))

    def _check_lead(self, batch: torch.Size) -> None:
        """Refuse a batch that does not begin with the missions."""
        lead = self.lead
        if batch[: len(lead)] != lead:
            raise ConfigurationError(
                f"dynamics: the model holds {tuple(lead)} missions, got a batch of shape "
                f"{tuple(batch)}; expected ({', '.join(map(str, lead))}, ...)"
            )
