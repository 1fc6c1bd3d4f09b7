"""The double pendulum of RealAIGym: acrobot and pendubot, all runs of a benchmark side by side."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.spaces.manifold import wrap_angle

DT, LIMIT, GRAVITY = 0.002, 6.0, 9.81  # s, N m, m/s^2
LENGTH, GEARS = 0.2, 6.0  # of the first link, m; of both motors
TIP = 0.3  # length of the second link, m
DRIVEN = {"acrobot": 1, "pendubot": 0}  # the joint that has a motor
GOAL = [math.pi, 0.0, 0.0, 0.0]


class Physics(NamedTuple):
    """Physics of a double pendulum; each field is a number, or one per run ``(N,)``.

    ``I`` are moments of inertia about the joints (kg m^2), ``r`` distances of the centres of mass
    from them (m), ``b`` dampings (N m s), ``cf`` Coulomb frictions (N m), ``Ir`` the inertia of a
    motor (kg m^2).
    """

    m1: Tensor | float = 0.5234602302310271
    m2: Tensor | float = 0.6255677234174437
    r1: Tensor | float = 0.2
    r2: Tensor | float = 0.25569305436052964
    I1: Tensor | float = 0.031887199591513114
    I2: Tensor | float = 0.05086984812807257
    b1: Tensor | float = 0.0
    b2: Tensor | float = 0.0
    cf1: Tensor | float = 0.0
    cf2: Tensor | float = 0.0
    Ir: Tensor | float = 0.0


NOMINAL = Physics()


def rates(state: Tensor, torque: Tensor, p: Physics) -> Tensor:
    r"""Return the rate of change of states ``(*B, 4)``: both angles (rad), both speeds (rad/s).

    .. math:: M(q)\,\ddot q = \tau - C(q, \dot q)\,\dot q + G(q) - b\,\dot q
        - c_f \arctan(100\,\dot q)

    Args:
        state: hanging at rest is zero.
        torque: at both joints, ``(*B, 2)``, N m.
        p: the pendulums.
    """
    first, second, speed1, speed2 = state.unbind(-1)
    arm = p.m2 * LENGTH * p.r2
    coupling, whirl = arm * second.cos(), arm * second.sin()
    m11 = p.I1 + p.I2 + p.m2 * LENGTH**2 + 2 * coupling + (GEARS**2 + 1) * p.Ir
    m12 = p.I2 + coupling - GEARS * p.Ir
    m22 = p.I2 + GEARS**2 * p.Ir
    weight1, weight2 = weights(state, p).unbind(-1)
    drag1 = p.b1 * speed1 + p.cf1 * (100 * speed1).atan()
    drag2 = p.b2 * speed2 + p.cf2 * (100 * speed2).atan()
    force1 = torque[..., 0] + whirl * speed2 * (2 * speed1 + speed2) - weight1 - drag1
    force2 = torque[..., 1] - whirl * speed1.square() - weight2 - drag2
    scale = m11 * m22 - m12 * m12
    turn1 = (m22 * force1 - m12 * force2) / scale
    turn2 = (m11 * force2 - m12 * force1) / scale
    return torch.stack([speed1, speed2, turn1, turn2], -1)


def weights(state: Tensor, p: Physics = NOMINAL) -> Tensor:
    """Return the torques ``(*B, 2)`` that hold states against gravity, N m."""
    first, both = state[..., 0].sin(), (state[..., 0] + state[..., 1]).sin()
    second = p.m2 * GRAVITY * p.r2 * both
    return torch.stack([(p.m1 * p.r1 + p.m2 * LENGTH) * GRAVITY * first + second, second], -1)


def height(state: Tensor) -> Tensor:
    """Return how far the end of the second link is above the first joint, m."""
    return -LENGTH * state[..., 0].cos() - TIP * (state[..., 0] + state[..., 1]).cos()


def step(state: Tensor, torque: Tensor, p: Physics = NOMINAL, dt: float = DT) -> Tensor:
    """Return the states a step later, by Runge-Kutta's fourth order."""
    k1 = rates(state, torque, p)
    k2 = rates(state + dt / 2 * k1, torque, p)
    k3 = rates(state + dt / 2 * k2, torque, p)
    k4 = rates(state + dt * k3, torque, p)
    return state + dt / 6 * (k1 + 2 * (k2 + k3) + k4)


def difference(state: Tensor, origin: Tensor) -> Tensor:
    """Return differences of states ``(*B, 4)``, with angles wrapped."""
    gap = state - origin
    return torch.cat([wrap_angle(gap[..., :2]), gap[..., 2:]], -1)
