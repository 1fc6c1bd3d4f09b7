"""The ground robot's nominal dynamics."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import torch
from torch import Tensor

from afm_rl.dynamics.base import closed_form
from afm_rl.dynamics.known import KnownDynamics
from afm_rl.options import Positive, options
from afm_rl.spaces.manifold import Manifold, wrap_angle


def dubins_step(state: Tensor, action: Tensor, dt: float) -> Tensor:
    r"""Return the state of a Dubins car after ``dt`` seconds.

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


class Dubins(KnownDynamics):
    """A Dubins car with unit gains: the model of the ``physics`` baseline.

    >>> model = Dubins()
    >>> model(torch.zeros(4, 3), torch.ones(4, 2)).shape
    torch.Size([4, 3])
    """

    affine = True
    extrapolates = True

    @options("dynamics")
    def __init__(
        self,
        dt: Annotated[Positive, "time step, s"] = 0.2,
        noise_std: Annotated[Positive, "standard deviation of a prediction, m and rad"] = 1e-3,
    ) -> None:
        super().__init__(partial(dubins_step, dt=dt), Manifold(3, angles=[2]), 2, noise_std)
        self.dt = dt

    @closed_form
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states ``(*B, N, H, 3)`` of plans, by cumulative sums."""
        x, y, theta = state[..., None, None, :].unbind(-1)
        # Sums are fast where the numbers of a plan lie together, and so are copies of the results.
        stride, turn = (part.contiguous() * self.dt for part in actions.unbind(-1))
        heading = theta + turn.cumsum(-1)
        before = heading - turn
        moved = (
            x + (stride * before.cos()).cumsum(-1),
            y + (stride * before.sin()).cumsum(-1),
            wrap_angle(heading),
        )
        return torch.stack(moved).movedim(0, -1)

    @closed_form
    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the closed form ``(*B, 3, 2)``."""
        theta = state[..., 2]
        zero = torch.zeros_like(theta)
        columns = (
            torch.stack([theta.cos() * self.dt, theta.sin() * self.dt, zero], -1),
            torch.stack([zero, zero, torch.full_like(theta, self.dt)], -1),
        )
        return torch.stack(columns, -1)
