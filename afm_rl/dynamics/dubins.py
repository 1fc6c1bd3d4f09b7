"""The ground robot's nominal dynamics."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.errors import check_number
from afm_rl.manifold import Manifold, wrap_angle


def dubins_step(state: Tensor, action: Tensor, dt: float) -> Tensor:
    r"""Move a Dubins car for ``dt`` seconds.

    .. math:: x' = x + v \cos\theta\,dt,\quad y' = y + v \sin\theta\,dt,\quad
              \theta' = \mathrm{wrap}(\theta + \omega\,dt)

    Args:
        state: x (m), y (m), theta (rad), ``(*B, 3)``.
        action: v (m/s), omega (rad/s), ``(*B, 2)``.
        dt: time step (s).

    >>> dubins_step(torch.zeros(3), torch.tensor([1.0, 0.5]), 0.2)
    tensor([0.2000, 0.0000, 0.1000])
    """
    x, y, theta = state.unbind(-1)
    v, omega = action.unbind(-1)
    stride = v * dt
    moved = (x + stride * theta.cos(), y + stride * theta.sin(), wrap_angle(theta + omega * dt))
    return torch.stack(moved, -1)


class Dubins(DynamicsModel):
    """A Dubins car with unit gains, as the ``physics`` baseline plans with it.

    Args:
        dt: time step (s).
        noise_std: standard deviation of the model's own error per step, in m and rad: how
            far it is trusted, not the simulator's noise.

    >>> model = Dubins()
    >>> model(torch.zeros(4, 3), torch.ones(4, 2)).shape
    torch.Size([4, 3])
    """

    def __init__(self, dt: float = 0.2, noise_std: float = 1e-3) -> None:
        super().__init__(Manifold(3, angles=[2]), action_size=2)
        self.dt = check_number("dynamics.dt", dt, low=0.0, open_low=True)
        self.noise_std = check_number("dynamics.noise_std", noise_std, low=0.0, open_low=True)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, 3)``."""
        return dubins_step(state, action, self.dt)

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return a single member's mean and unit variance, in units of ``noise_std``."""
        mean = self.standardise(self.manifold.difference(self(state, action), state))
        return mean.unsqueeze(-2), torch.zeros_like(mean).unsqueeze(-2)

    def standardise(self, change: Tensor) -> Tensor:
        """Divide by ``noise_std``."""
        return change / self.noise_std

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        """Return ``noise_std`` for every coordinate."""
        return torch.full_like(state, self.noise_std)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the closed form ``(*B, 3, 2)``."""
        theta = state[..., 2]
        zero = torch.zeros_like(theta)
        columns = (
            torch.stack([theta.cos() * self.dt, theta.sin() * self.dt, zero], -1),
            torch.stack([zero, zero, torch.full_like(theta, self.dt)], -1),
        )
        return torch.stack(columns, -1)
