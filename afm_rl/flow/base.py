"""The contract between the transform and what corrects its actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

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

    pairs: Tensor
    """What it found each transition of the window to mean, ``(*B, K, R)``."""
    evidence: Tensor
    """How badly each of its hypotheses did of late, ``(*B, E)``."""
    features: Tensor
    """Description of the regime, ``(*B, D)``."""
    surprise: Tensor
    """Size of the misalignment, in the unit of the gate, ``(*B)``."""
    misaligned: Tensor
    """Is the model misaligned? ``(*B)``."""


class Correction(NamedTuple):
    """What to execute instead of a planned action."""

    action: Tensor
    """The action, ``(*B, A)``."""
    spread: Tensor
    """Its standard deviation over samples, ``(*B, A)``."""
    reach: Tensor | None = None
    """Lowest and highest effect that an action can have, ``(*B, 2, A)``; None: the box."""
    expected: Tensor | None = None
    """What the action is expected to be worth, ``(*B, A)``; None: what was planned."""


def rows_of(mask: Tensor) -> Any:
    """Return an index of the missions of a mask ``(*B)``: of all of them one that copies nothing.

    >>> rows_of(torch.tensor([True, True])), rows_of(torch.tensor([True, False]))
    (Ellipsis, tensor([ True, False]))
    """
    return ... if bool(mask.all()) else mask


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
        self.gate = check_number("corrector.gate", gate, low=0.0)
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
    def context_size(self) -> int:
        """Numbers of a context that are remembered, in ``Context.features``."""
        return self.feature_size

    @property
    def pair_size(self) -> int:
        """Numbers that are kept of each transition, R."""
        return 0

    @property
    def evidence_size(self) -> int:
        """Number of hypotheses, E."""
        return 0

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
    def context(self, window: Window, model: DynamicsModel, last: Context | None = None) -> Context:
        """Describe the regime under the *present* model.

        Args:
            window: the last transitions.
            model: the dynamics model as it is now.
            last: the answer one transition ago, so that not everything need be done again.
        """

    @abstractmethod
    def correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Return the action to execute for a planned one, ``(*B, A)``."""


class Examples(NamedTuple):
    """Training examples of a flow."""

    features: Tensor
    """Context, ``(N, C)``."""
    planned: Tensor
    """Planned action, ``(N, A)``."""
    intended: Tensor
    """Action to execute instead, ``(N, A)``."""
    probe: Tensor
    """Another executed action, ``(N, A)``."""
    worth: Tensor
    """Its effect, ``(N, A)``."""


class Flow(Corrector):
    """A corrector that learns a velocity field from the planned action to the corrected one."""

    def read(self, features: Tensor) -> Any:
        """Return what the networks make of a context ``(*B, C)``; by default the features.

        Done once for a context, however much is then asked about it.
        """
        return features

    def told(self, features: Tensor) -> Context:
        """Return the context ``(*B)`` of a model that is off, of which features tell all."""
        nothing, size = features[..., :0], features[..., 0]
        return Context(nothing, nothing, features, size, size.bool())

    @abstractmethod
    def forward(self, known: Any, planned: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity ``(*B, A)`` at ``point`` and time ``tau`` ``(*B, 1)``, in u.

        ``known`` is what :meth:`read` returned.
        """

    has_effect = False
    """Does it also know what actions are worth?"""

    def effect(self, known: Any, executed: Tensor) -> Tensor:
        """Return what an executed action is expected to be worth, ``(*B, A)``, in u."""
        raise NotImplementedError(f"{type(self).__name__} knows one direction only")

    @abstractmethod
    def source(self, planned: Tensor, noise: Tensor) -> Tensor:
        """Return the start of the path for planned u and standard normal noise."""

    @abstractmethod
    def examples(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
        plans: int = 1,
    ) -> Examples:
        """Make ``count`` counterfactual examples: what the model would have been seen to do.

        Where contexts are dear, several ``plans`` can be drawn for each. ``states`` are a box,
        lowest and highest, or a pool of observed ones ``(P, S)``.
        """
