"""Dynamics that are written down, not learned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.errors import ConfigurationError, check_flag, check_number
from afm_rl.spaces.manifold import Manifold


class KnownDynamics(DynamicsModel):
    """Any step function as a dynamics model: physics, a simulator in torch, a network of yours.

    Args:
        step: ``step(state, action) -> next state``, batched and differentiable.
        manifold: state space.
        action_size: number of action components, A.
        noise_std: standard deviation of the model's own error per step, one number or one
            per coordinate, in the state's units: how far it is trusted, not the noise of a
            simulator.
        affine: whether the next state is affine in the action: effective actions then take one
            round.

    >>> def push(state, action):  # a cart: position (m), speed (m/s); force (N)
    ...     return state + 0.1 * torch.cat([state[..., 1:], action], -1)
    >>> model = KnownDynamics(push, Manifold(2), action_size=1)
    >>> model.jacobian(torch.zeros(2), torch.zeros(1)).squeeze(-1)
    tensor([0.0000, 0.1000])
    """

    noise: Tensor

    def __init__(
        self,
        step: Callable[[Tensor, Tensor], Tensor],
        manifold: Manifold,
        action_size: int,
        noise_std: float | Sequence[float] = 1e-3,
        affine: bool = False,
    ) -> None:
        super().__init__(manifold, action_size)
        self.affine = self.affine or check_flag("dynamics.affine", affine)
        if not callable(step):
            raise ConfigurationError(f"dynamics.step={step!r}: expected a function")
        self.step = step
        given = [noise_std] if isinstance(noise_std, int | float) else list(noise_std)
        size = manifold.tangent_size
        if len(given) not in (1, size):
            raise ConfigurationError(
                f"dynamics.noise_std={given}: expected one number, or {size} numbers"
            )
        checked = [check_number("dynamics.noise_std", x, low=0.0, open_low=True) for x in given]
        self.register_buffer("noise", torch.tensor(checked).expand(size).clone(), persistent=False)

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

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return a single member's mean and unit variance, in units of ``noise_std``."""
        mean = self.standardise(self.manifold.difference(self(state, action), state))
        return mean.unsqueeze(-2), torch.zeros_like(mean).unsqueeze(-2)

    def standardise(self, change: Tensor) -> Tensor:
        return change / self.noise

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self.noise.to(state).expand(*state.shape[:-1], -1)
