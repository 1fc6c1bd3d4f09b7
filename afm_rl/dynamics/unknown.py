"""A stand-in for physics that are not known."""

from __future__ import annotations

from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.errors import ConfigurationError


class UnknownDynamics(DynamicsModel):
    """The sizes of a model, and nothing else: whatever it is asked, it raises.

    >>> from afm_rl.spaces.manifold import Manifold
    >>> UnknownDynamics(Manifold(3), action_size=2).state_size
    3
    """

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Raise a :class:`~afm_rl.errors.ConfigurationError`."""
        raise ConfigurationError(
            "robot.model: the physics of this robot are not known; choose dynamics=pe, which "
            "learns from the robot's own transitions (method=frozen_pe, afm_frozen_pe, ...), or "
            "give a model"
        )

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return self(state, action), state

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self(state, action)
