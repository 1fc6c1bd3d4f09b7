"""OMAC's inverted pendulum in gusts of wind, and a controller that does not model them.

Shi et al. 2021, "Meta-Adaptive Nonlinear Control: Theory and Algorithms", arXiv 2106.06098.
"""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics
from afm_rl.envs.task.own import Limits
from afm_rl.envs.task.task import NOWHERE, Reward, Task
from afm_rl.errors import check_count
from afm_rl.regimes import Regime
from afm_rl.spaces.manifold import Manifold

MASS, LENGTH, GRAVITY, BELIEVED = 1.0, 0.5, 9.81, 9.0  # kg, m, m/s^2, m/s^2
DRAG, DAMPING, NOISE = 0.5, 1.0, 0.1  # of air; N m s; N m
STEP, STEPS, HOLD = 0.01, 6000, 200  # s; steps of an episode, and of a gust
INERTIA = MASS * LENGTH**2
TORQUE = 20.0  # N m


def believed(state: Tensor, torque: Tensor) -> Tensor:
    """Step of the controller's model of the pendulum; the state is angle (0 is up) and speed.

    >>> believed(torch.tensor([0.0, 1.0]), torch.tensor([0.25]))
    tensor([0.0101, 1.0100])
    """
    angle, speed = state.unbind(-1)
    lift = MASS * LENGTH * BELIEVED * angle.sin()
    speed = speed + STEP / INERTIA * (lift + torque[..., 0])
    return torch.stack([angle + STEP * speed, speed], -1)


def steer(state: Tensor, gain: float = 1.5) -> Tensor:
    r"""Return the controller's torque (N m).

    .. math:: u = -m l^2 k\,\dot\theta - m l \hat g \sin\theta - k\,(\dot\theta + k\,\theta)
    """
    angle, speed = state.unbind(-1)
    lift = MASS * LENGTH * BELIEVED * angle.sin()
    torque = -INERTIA * gain * speed - lift - gain * (speed + gain * angle)
    return torque.unsqueeze(-1)


class Gusts(Regime):
    r"""What the controller does not model: wind w, drag, damping, a part of gravity, and noise.

    .. math:: u_\mathrm{eff} = u + m l (g - \hat g) \sin\theta - \dot\theta
              + l\,t^\top (0.5\,|r|\,r) + 0.1\,\epsilon,\qquad r = w - l\,\dot\theta\,t

    with :math:`t = (\cos\theta, -\sin\theta)`. Parameters: ``outside`` (0: none of it, 1: all) and
    the wind (m/s).

    >>> gusts = Gusts()
    >>> still = gusts.encode({"outside": 1.0})
    >>> gusts.apply(torch.zeros(1), still, torch.tensor([0.0, 1.0]))
    tensor([-1.0625])
    """

    names = ("outside", "gust_x", "gust_z")
    identity = (0.0, 0.0, 0.0)
    noisy = True
    by_state = True

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        moved = action + self._torque(parameters, state)
        return moved if noise is None else moved + parameters[..., :1] * NOISE * noise

    def command_for(self, effect: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        return effect - self._torque(parameters, state)

    def _torque(self, parameters: Tensor, state: Tensor) -> Tensor:
        """Return the mean torque from outside ``(*B, 1)``."""
        angle, speed = state.unbind(-1)
        along = torch.stack([angle.cos(), -angle.sin()], -1)
        flow = parameters[..., 1:] - LENGTH * speed.unsqueeze(-1) * along
        push = LENGTH * DRAG * flow.norm(dim=-1) * (flow * along).sum(-1)
        lift = MASS * LENGTH * (GRAVITY - BELIEVED) * angle.sin()
        return parameters[..., :1] * (lift - DAMPING * speed + push).unsqueeze(-1)


def lean(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward: the angle (rad), negative."""
    return -after[..., 0].abs()


def winds(seed: int, count: int) -> list[dict[str, float]]:
    """Return ``count`` gusts, each drawn from N(0, 1)^2."""
    drawn = torch.randn(count, 2, generator=torch.Generator().manual_seed(1000 + seed))
    return [{"outside": 1.0, "gust_x": x, "gust_z": z} for x, z in drawn.tolist()]


def gusty_pendulum_task(
    reward: Reward | None = None,
    steps: int | None = None,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return OMAC's pendulum; its family of regimes ``gusts`` has ten winds of 30 gusts.

    Args:
        reward: instead of the negative angle.
        steps: length of an episode; 60 s if None.
        action_low: lowest torque (N m).
        action_high: highest torque.

    >>> len(gusty_pendulum_task().contexts["gusts"][0])
    30
    """
    noise = [1e-4, NOISE * STEP / INERTIA]

    def start(seed: int) -> tuple[Tensor, Tensor]:
        drawn = torch.rand(1, generator=torch.Generator().manual_seed(seed))
        return torch.cat([(2 * drawn - 1) * torch.pi / 4, torch.zeros(1)]), NOWHERE

    return Task(
        name="gusty_pendulum",
        world=KnownDynamics(believed, Manifold(2, angles=[0]), 1, noise, affine=True),
        start=start,
        reward=lean if reward is None else reward,
        low=action_low or [-TORQUE],
        high=action_high or [TORQUE],
        dt=STEP,
        steps=STEPS if steps is None else check_count("robot.steps", steps),
        state_names=["angle", "speed"],
        action_names=["torque"],
        contexts={"gusts": [winds(seed, STEPS // HOLD) for seed in range(10)]},
    )
