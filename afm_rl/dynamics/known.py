"""Dynamics that are written down, not learned, with or without parameters that can be set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated

import torch
from torch import Tensor, nn

from afm_rl.dynamics.base import DynamicsModel, PerMissionModel
from afm_rl.errors import ConfigurationError
from afm_rl.options import Positive, options
from afm_rl.spaces.manifold import Manifold


class KnownDynamics(DynamicsModel):
    """Any step function as a dynamics model: physics, a simulator in torch, a network of yours.

    Args:
        step: ``step(state, action) -> next state``, batched and differentiable.
        manifold: state space.
        action_size: number of action components, A.

    >>> def push(state, action):  # a cart: position (m), speed (m/s); force (N)
    ...     return state + 0.1 * torch.cat([state[..., 1:], action], -1)
    >>> model = KnownDynamics(push, Manifold(2), action_size=1)
    >>> model.jacobian(torch.zeros(2), torch.zeros(1)).squeeze(-1)
    tensor([0.0000, 0.1000])
    """

    noise: Tensor

    @options("dynamics")
    def __init__(
        self,
        step: Callable[[Tensor, Tensor], Tensor],
        manifold: Manifold,
        action_size: int,
        noise_std: Annotated[
            Positive | Sequence[Positive],
            "standard deviation of a prediction, in units of the state",
        ] = 1e-3,
        affine: Annotated[bool, "the next state is affine in the action"] = False,
    ) -> None:
        super().__init__(manifold, action_size)
        self.affine = self.affine or affine
        if not callable(step):
            raise ConfigurationError(f"dynamics.step={step!r}: expected a function")
        self.step = step
        given = [noise_std] if isinstance(noise_std, int | float) else list(noise_std)
        size = manifold.tangent_size
        if len(given) not in (1, size):
            raise ConfigurationError(
                f"dynamics.noise_std={given}: expected one number, or {size} numbers"
            )
        self.register_buffer("noise", torch.tensor(given).expand(size).clone(), persistent=False)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, S)``.

        Raises:
            ConfigurationError: if the step function fails, or returns anything else.
        """
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        try:
            ahead = self.step(state, action)
        except (IndexError, RuntimeError, TypeError, ValueError) as error:
            raise self._refusal(f"fails ({error})", state, action) from error
        if not isinstance(ahead, Tensor) or ahead.shape != (*batch, state.shape[-1]):
            found = tuple(ahead.shape) if isinstance(ahead, Tensor) else type(ahead).__name__
            raise self._refusal(f"returned {found}", state, action)
        return ahead

    def _refusal(self, what: str, state: Tensor, action: Tensor) -> ConfigurationError:
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        return ConfigurationError(
            f"dynamics.step: {what} for states {tuple(state.shape)} and actions "
            f"{tuple(action.shape)}; expected a tensor {(*batch, state.shape[-1])}: a step "
            "function in torch that works on the last dimension, as in state[..., 0]"
        )

    def standardise(self, change: Tensor) -> Tensor:
        return change / self.noise

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self.noise.to(state).expand(*state.shape[:-1], -1)


STEP = 1e-5  # of central differences: in double precision far above rounding, in any usual unit


class PhysicsModel(PerMissionModel):
    """A model whose physics can be set, for all missions or for each.

    Subclasses call :meth:`_name_physics` and read :meth:`_physics_for`.
    """

    nominal: Tensor
    physics_now: Tensor
    physics_names: tuple[str, ...]

    def _name_physics(self, physics: Mapping[str, float]) -> None:
        """Keep names of what may change, and the values that change nothing."""
        self.physics_names = tuple(physics)
        nominal = torch.tensor([float(value) for value in physics.values()])
        self.register_buffer("nominal", nominal, persistent=False)
        self.register_buffer("physics_now", nominal, persistent=False)

    def set_physics(self, physics: Tensor | None) -> None:
        """Change the physics from now on: rows ``(P,)``, or ``(*L, P)`` for leading dimensions.

        None for the nominal ones.
        """
        self.physics_now = self.nominal if physics is None else physics.detach()

    @contextmanager
    def assuming(self, physics: Tensor) -> Iterator[None]:
        """Predict with other physics ``(*L, P)`` within a ``with`` block."""
        now = self.physics_now
        self.set_physics(physics)
        try:
            yield
        finally:
            self.physics_now = now

    def _owned(self) -> list[tuple[nn.Module, str]]:
        return [(self, "physics_now")]

    def _physics_for(self, dims: int) -> Tensor:
        """Return the physics with dimensions for a batch of ``dims``, ``(*L, 1, ..., P)``."""
        rows = self.physics_now
        return rows.reshape(*rows.shape[:-1], *[1] * (dims + 1 - rows.dim()), -1)


class ParametricDynamics(KnownDynamics, PhysicsModel):
    """A step function with physical parameters as a dynamics model.

    Derivatives are central differences in double precision: torch's forward differentiation takes a
    millisecond for each product with a tensor that is not differentiated, such as these parameters.

    Args:
        step: ``step(state, action, physics) -> next state``, batched, not necessarily
            differentiable; physics ``(*B, P)`` are in the order of their names.
        manifold: state space.
        action_size: number of action components, A.
        physics: names of the parameters, with their nominal values.

    >>> def push(state, force, physics):  # a cart: position (m), speed (m/s); force (N)
    ...     return state + 0.1 * torch.cat([state[..., 1:], force / physics], -1)
    >>> model = ParametricDynamics(push, Manifold(2), 1, {"mass": 2.0})
    >>> with model.assuming(torch.tensor([[1.0], [4.0]])):  # two missions
    ...     model(torch.zeros(2, 3, 2), torch.ones(2, 3, 1))[:, 0, 1]
    tensor([0.1000, 0.0250])
    """

    extrapolates = True

    def __init__(
        self,
        step: Callable[[Tensor, Tensor, Tensor], Tensor],
        manifold: Manifold,
        action_size: int,
        physics: Mapping[str, float],
        noise_std: float | Sequence[float] = 1e-3,
        affine: bool = False,
    ) -> None:
        def now(state: Tensor, action: Tensor) -> Tensor:
            return step(state, action, self._physics_for(action.dim() - 1).to(state))

        super().__init__(now, manifold, action_size, noise_std, affine)
        self._name_physics(physics)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return central differences ``(*B, D, A)``."""
        after = self._beside(state, action, torch.eye(self.action_size), state.shape[-1])
        change = self.manifold.difference(*after[..., 1:, :].chunk(2, -2))
        return (change.mT / (2 * STEP)).to(action.dtype)

    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the next state and central differences by state and action."""
        after = self._beside(state, action, torch.eye(self.state_size + self.action_size))
        more, less = after[..., 1:, :].chunk(2, -2)
        change = self.manifold.subtract(more, less)
        slopes = (change.mT / (2 * STEP)).to(action.dtype)
        by_state, by_action = slopes.split([self.state_size, self.action_size], -1)
        return after[..., 0, :].to(state.dtype), by_state, by_action

    def _beside(self, state: Tensor, action: Tensor, axes: Tensor, still: int = 0) -> Tensor:
        """Return what follows a state, and states and actions beside it; ``(*B, 1 + 2 K, S)``.

        The axes ``(K, ...)`` are of states and actions; of actions only if ``still`` is S.
        """
        axes = torch.nn.functional.pad(axes.to(action), (still, 0)).double()
        steps = STEP * torch.cat([axes.new_zeros(1, axes.shape[-1]), axes, -axes])
        whole = torch.cat([state.expand(*action.shape[:-1], -1), action], -1).double()
        moved = whole.unsqueeze(-2) + steps
        return self(moved[..., : self.state_size], moved[..., self.state_size :])
