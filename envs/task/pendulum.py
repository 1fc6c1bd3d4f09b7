"""The step of gymnasium's Pendulum-v1, which it keeps to itself."""

from __future__ import annotations

import torch
from torch import Tensor


def pendulum_step(state: Tensor, action: Tensor) -> Tensor:
    """Step of gymnasium's Pendulum-v1; the state is angle (rad, 0 is up) and speed (rad/s).

    >>> pendulum_step(torch.zeros(2), torch.tensor([2.0]))
    tensor([0.0150, 0.3000])
    """
    angle, speed = state.unbind(-1)
    speed = (speed + 0.05 * (15 * angle.sin() + 3 * action[..., 0])).clamp(-8.0, 8.0)
    return torch.stack([angle + 0.05 * speed, speed], -1)


def pendulum_observation(state: Tensor) -> Tensor:
    """Return what gymnasium's Pendulum-v1 shows: cosine and sine of the angle, and the speed.

    >>> pendulum_observation(torch.tensor([0.0, 3.0]))
    tensor([1., 0., 3.])
    """
    angle, speed = state.unbind(-1)
    return torch.stack([angle.cos(), angle.sin(), speed], -1)
