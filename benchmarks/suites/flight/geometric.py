"""Geometric tracking control of a quadrotor: the classical controller without a horizon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import roma
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from afm_rl.dynamics.quadrotor import check_body
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.spaces.airframe import QuadrotorBody, within_motors
from afm_rl.spaces.keys import as_key

LEAST = 1.0  # m/s^2 upwards: with less, tilting would not steer


class Gains(NamedTuple):
    """Gains along or about x, y and z, ``(3,)`` each."""

    position: Tensor
    """Acceleration per error of the position (1/s^2)."""
    velocity: Tensor
    """Acceleration per error of the velocity (1/s)."""
    attitude: Tensor
    """Angular acceleration per error of the attitude (1/s^2)."""
    rate: Tensor
    """Angular acceleration per body rate (1/s)."""


def geometric_wrench(
    state: Tensor,
    reference: Tensor,
    acceleration: Tensor,
    body: QuadrotorBody,
    gains: Gains,
    tilt: float,
) -> Tensor:
    r"""Return the thrust and moments that lead a quadrotor to its reference, ``(*B, 4)``.

    .. math:: f = \ddot r_d - k_r (r - r_d) - k_v (\dot r - \dot r_d) + g e_3,\quad
              T = m\,f \cdot R e_3,\quad
              M = J (-k_R e_R - k_\omega \omega) + \omega \times J \omega

    with :math:`e_R = \tfrac12 (R_d^\top R - R^\top R_d)^\vee`, where :math:`R_d` has its third
    axis along f and its first axis as near as possible to the world's x axis. The vertical part of
    f is at least 1 m/s^2 and at most that of the largest thrust; its level part is shortened until
    f is within ``tilt``; T is not negative. The result is the wrench that the motors can give.

    Args:
        state: position (m), velocity (m/s), quaternion (scalar-last), body rate (rad/s),
            ``(*B, 13)``.
        reference: desired position and velocity, ``(*B, 6)``.
        acceleration: that of the reference (m/s^2), ``(*B, 3)``.
        body: the assumed quadrotor.
        gains: all gains.
        tilt: largest desired tilt (rad).

    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> gains = Gains(*torch.ones(4, 3))
    >>> geometric_wrench(level, torch.zeros(6), torch.zeros(3), QuadrotorBody(), gains, 0.8)
    tensor([0.2943, 0.0000, 0.0000, 0.0000])
    """
    position, velocity, quaternion, rate = state.split([3, 3, 4, 3], -1)
    wanted = acceleration - gains.position * (position - reference[..., :3])
    wanted = wanted - gains.velocity * (velocity - reference[..., 3:])
    force = _within_means(wanted, body, tilt)
    turned = roma.unitquat_to_rotmat(quaternion)  # R
    thrust = body.mass * (force * turned[..., 2]).sum(-1, keepdim=True)
    thrust = thrust.clamp_min(0.0)  # less would cost the moments that turn an upset body back

    unit = torch.eye(3, dtype=state.dtype, device=state.device)
    third = force / force.norm(dim=-1, keepdim=True)
    second = torch.linalg.cross(third, unit[0].expand_as(third))
    second = second / second.norm(dim=-1, keepdim=True)
    axes = torch.stack([torch.linalg.cross(second, third), second, third], -2)
    seen = axes @ turned  # rows: columns of R' R_d
    error = torch.linalg.cross(seen, unit.expand_as(seen)).sum(-2) / 2
    inertia = torch.tensor(body.inertia, dtype=state.dtype, device=state.device)
    moment = inertia * (-gains.attitude * error - gains.rate * rate)
    moment = moment + torch.linalg.cross(rate, inertia * rate)
    return within_motors(torch.cat([thrust, moment], -1), body)


def _within_means(wanted: Tensor, body: QuadrotorBody, tilt: float) -> Tensor:
    """Return the desired acceleration, limited to an achievable one with an upward part."""
    up = (wanted[..., 2:] + body.gravity).clamp(LEAST, body.max_thrust / body.mass)
    level = wanted[..., :2]
    reach = math.tan(tilt) * up
    return torch.cat([level * reach / level.norm(dim=-1, keepdim=True).maximum(reach), up], -1)


class GeometricController(TensorDictModuleBase):
    r"""A quadrotor's geometric tracking controller, as a planner without a horizon.

    See :func:`geometric_wrench`; Lee, Leok and McClamroch, Geometric Tracking Control of a
    Quadrotor UAV on SE(3) (2010). Gains are per unit of mass and inertia, the desired body rate
    is taken for zero, and the heading stays along x. The reference's acceleration is the mean
    over the coming tick, from its preview; zero without one.

    The action is held for a tick, which bounds the gains. From a moment to the level position
    there are four integrators. At ``dt`` = 0.05 s the default gains put the four poles of this
    chain, sampled, to :math:`e^{-5 \Delta t}` (5 rad/s), and the two of the height to
    :math:`e^{-10 \Delta t}`. Both loops stay stable while the effect of the thrust is 0.4 to 2.5
    times the assumed one (masses of 250 % to 40 %).

    Args:
        env: the planning environment: the keys of state and action, and the action bounds.
        dt: control tick (s).
        horizon: length N of the preview of the reference, ticks.
        position: acceleration per error of the position along x, y and z (1/s^2).
        velocity: acceleration per error of the velocity (1/s).
        attitude: angular acceleration per error of the attitude about x, y and z (1/s^2).
        rate: angular acceleration per body rate (1/s).
        tilt: largest desired tilt (rad), below pi/2.
        body: the nominal quadrotor, a Crazyflie if None.
        reference_key: desired position and velocity: ``(*B, N + 1, 6)``, now and after each of
            the next ticks, or ``(*B, 6)``.
        action_key: key of the action.

    Raises:
        ConfigurationError: for a setting that cannot be used, or a reference of another shape.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Quadrotor
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> env = PlanningEnv(Quadrotor(), GoalDistance(), *QuadrotorBody().bounds)
    >>> level = torch.zeros(5, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> td = TensorDict({"observation": level, "reference": torch.zeros(5, 6)}, [5])
    >>> GeometricController(env)(td)["action"].shape
    torch.Size([5, 4])
    """

    def __init__(
        self,
        env: PlanningEnv,
        dt: float = 0.05,
        horizon: int = 1,
        position: Sequence[float] = (3.8, 3.8, 62.0),
        velocity: Sequence[float] = (3.14, 3.14, 14.2),
        attitude: Sequence[float] = (101.0, 101.0, 101.0),
        rate: Sequence[float] = (15.0, 15.0, 15.0),
        tilt: float = 0.8,
        body: QuadrotorBody | None = None,
        reference_key: NestedKey = "reference",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        sizes = env.dynamics.state_size, env.dynamics.action_size
        if sizes != (13, 4):
            raise ConfigurationError(
                f"planner: the geometric controller flies quadrotors (13 states, 4 actions), but "
                f"the dynamics model has {sizes[0]} and {sizes[1]}; choose robot=quadrotor"
            )
        self.dt = check_number("planner.dt", dt, low=0.0, open_low=True)
        self.horizon = check_count("planner.horizon", horizon, high=10_000)
        self.stages = horizon + 1
        self.tilt = check_number("planner.tilt", tilt, low=0.0, high=1.5, open_low=True)
        self.body = check_body(body)
        for name, values in zip(Gains._fields, (position, velocity, attitude, rate), strict=True):
            if isinstance(values, (str, int, float)) or len(values) != 3:
                raise ConfigurationError(
                    f"planner.{name}={values!r}: expected three gains, one for each of x, y and z"
                )
            checked = [check_number(f"planner.{name}", value, low=0.0) for value in values]
            gains = torch.tensor(checked, dtype=torch.float64)
            self.register_buffer(f"{name}_gains", gains, persistent=False)
        self.env, self.reference_key = env, as_key(reference_key)
        self.action_key = as_key(action_key)
        self.action_spec = env.full_action_spec[self.action_key]
        self.in_keys = [env.observation_key, self.reference_key]
        self.out_keys = [self.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        state = tensordict.get(self.env.observation_key)
        reference, acceleration = self._reference(tensordict)
        names = (f"{name}_gains" for name in Gains._fields)
        gains = Gains(*(getattr(self, name).to(state) for name in names))
        flight = state, reference.to(state), acceleration.to(state)
        wrench = geometric_wrench(*flight, self.body, gains, self.tilt)
        return tensordict.set(self.action_key, self.action_spec.project(wrench))

    def _reference(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return desired position and velocity ``(*B, 6)``, and acceleration ``(*B, 3)``."""
        entry, batch = tensordict.get(self.reference_key, None), tensordict.batch_size
        held, staged = (*batch, 6), (*batch, self.horizon + 1, 6)
        if entry is None or entry.shape not in (held, staged):
            given = "is missing" if entry is None else f"has shape {tuple(entry.shape)}"
            raise ConfigurationError(
                f"planner: {self.reference_key!r} {given}; expected {held}, or {staged} with a "
                "preview"
            )
        if entry.shape == held:
            return entry, torch.zeros_like(entry[..., 3:])
        return entry[..., 0, :], (entry[..., 1, 3:] - entry[..., 0, 3:]) / self.dt
