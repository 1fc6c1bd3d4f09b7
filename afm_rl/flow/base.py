"""The contract between the transform and what corrects its actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.regimes import Regime


class Window(NamedTuple):
    """The last K transitions, oldest first."""

    state: Tensor
    """States, ``(*B, K, S)``."""
    planned: Tensor
    """Planned actions, ``(*B, K, A)``."""
    executed: Tensor
    """Executed actions, ``(*B, K, A)``."""
    next_state: Tensor
    """Realised next states, ``(*B, K, S)``."""
    valid: Tensor
    """Which rows hold a transition, ``(*B, K)``."""


class Context(NamedTuple):
    """What a corrector reads in a window."""

    features: Tensor
    """Description of the regime, ``(*B, C)``."""
    surprise: Tensor
    """Size of the misalignment, in the unit of the gate, ``(*B)``."""
    misaligned: Tensor
    """Is the model misaligned? ``(*B)``."""


class Corrector(nn.Module, ABC):
    """Turns planned actions into executed ones, given what the window shows.

    Actions are handled in units of half ranges around the centre of their box, u in
    [-1, 1]^A.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        gate: misalignment above which actions are corrected.
        window: number of transitions needed, K.
    """

    centre: Tensor
    half_range: Tensor

    def __init__(self, action_low: Tensor, action_high: Tensor, gate: float, window: int) -> None:
        super().__init__()
        low, high = torch.as_tensor(action_low), torch.as_tensor(action_high)
        fits = low.shape == high.shape and low.dim() == 1
        if not fits or not bool(((low < high) & (high - low).isfinite()).all()):
            raise ConfigurationError(
                f"flow: action bounds {low.tolist()}, {high.tolist()}: expected two lists of "
                "one size, finite, low < high"
            )
        self.gate = check_number("flow.gate", gate, low=0.0)
        self.window = window
        self.register_buffer("centre", (low + high) / 2, persistent=False)
        self.register_buffer("half_range", (high - low) / 2, persistent=False)

    @property
    def action_size(self) -> int:
        """Number of action components, A."""
        return len(self.centre)

    @property
    @abstractmethod
    def feature_size(self) -> int:
        """Number of context features, C."""

    @property
    def signature(self) -> dict[str, object]:
        """What a stored corrector must agree in to be loaded."""
        return {
            "kind": type(self).__name__,
            "action_size": self.action_size,
            "feature_size": self.feature_size,
        }

    def normalise(self, action: Tensor) -> Tensor:
        """Return u for an action in its own units."""
        return (action - self.centre) / self.half_range

    def denormalise(self, unit: Tensor) -> Tensor:
        """Return the action for u."""
        return self.centre + self.half_range * unit

    @abstractmethod
    def context(self, window: Window, model: DynamicsModel, last: Context) -> Context:
        """Describe the regime under the *present* model; ``last`` is the previous answer."""

    @abstractmethod
    def correct(self, context: Context, state: Tensor, planned: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action to execute and its spread over samples, ``(*B, A)`` each."""


class Examples(NamedTuple):
    """Training examples of a flow."""

    features: Tensor
    """Context, ``(N, C)``."""
    planned: Tensor
    """Planned action, ``(N, A)``."""
    intended: Tensor
    """Action to execute instead, ``(N, A)``."""


class Flow(Corrector):
    """A corrector that learns a velocity field from the planned action to the corrected one."""

    @abstractmethod
    def forward(self, features: Tensor, planned: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity ``(*B, A)`` at ``point`` and time ``tau`` ``(*B, 1)``, in u."""

    @abstractmethod
    def source(self, planned: Tensor, noise: Tensor) -> Tensor:
        """Return the start of the path for planned u and standard normal noise."""

    @abstractmethod
    def examples(
        self,
        model: DynamicsModel,
        regime: Regime,
        state_box: tuple[Tensor, Tensor],
        count: int,
        generator: torch.Generator,
        plans: int = 1,
    ) -> Examples:
        """Make ``count`` counterfactual examples: what the model would have been seen to do.

        Where contexts are dear, several ``plans`` can be drawn for each.
        """
