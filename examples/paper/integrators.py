"""Other ways in which a planner may integrate the motion of the ground robot.

    afm-rl "trust=[examples/paper/integrators]" method=physics robot.model._target_=integrators.Arc

The paper states the motion of the Dubins car, but not how Physics integrates it. The robot itself
keeps moving as :class:`~afm_rl.dynamics.Dubins`; only the planner's model differs.
"""

import torch
from torch import Tensor

from afm_rl.dynamics import Dubins


class TurnFirst(Dubins):
    """Turns, then moves along the new heading.

    >>> TurnFirst(dt=1.0)(torch.zeros(3), torch.tensor([1.0, torch.pi / 2])).round(decimals=2)
    tensor([0.0000, 1.0000, 1.5700])
    """

    affine = False

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, 3)``."""
        v, omega = action.split(1, -1)
        turned = super().forward(state, torch.cat([torch.zeros_like(v), omega], -1))
        return super().forward(turned, torch.cat([v, torch.zeros_like(omega)], -1))


class Arc(Dubins):
    """Moves along the arc that constant v and omega describe, which is exact.

    >>> Arc(dt=1.0)(torch.zeros(3), torch.tensor([torch.pi / 2, torch.pi / 2])).round(decimals=2)
    tensor([1.0000, 1.0000, 1.5700])
    """

    affine = False

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, 3)``."""
        v, omega = action.split(1, -1)
        half = torch.cat([torch.zeros_like(v), omega / 2], -1)
        chord = torch.cat([v * torch.sinc(omega * self.dt / (2 * torch.pi)), 0 * omega], -1)
        return super().forward(super().forward(super().forward(state, half), chord), half)


class Unwrapped(Dubins):
    """Does not wrap headings, so that a plan across +-pi has a larger cost.

    >>> Unwrapped(dt=1.0)(torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, 1.0]))[2]
    tensor(4.)
    """

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, 3)``."""
        heading = (state[..., 2] + action[..., 1] * self.dt).unsqueeze(-1)
        return torch.cat([super().forward(state, action)[..., :2], heading], -1)
