"""A quadrotor: its equations of motion, their derivatives, and the nominal model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated, NamedTuple

import roma
import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.dynamics.base import closed_form, jacobian_of_linearised
from afm_rl.dynamics.known import KnownDynamics
from afm_rl.dynamics.rates import HeldRate, runge_kutta_linearised, runge_kutta_path
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, Positive, options
from afm_rl.spaces.airframe import QuadrotorBody
from afm_rl.spaces.manifold import RigidBodySpace


class _Tables(NamedTuple):
    """The products of two attitude and rate components that make up a rate of change."""

    first: Tensor  # (30,) index of one factor in the state
    second: Tensor  # (30,) index of the other
    factor: Tensor  # (3, 10) up to three products for each of b_3, q' and the gyroscopic w'
    slope: Tensor  # (7, 70) derivative of these sums by (q, w), linear in (q, w)
    inverse: Tensor  # (3,) one over the moments of inertia
    weight: Tensor  # (3,) acceleration of gravity
    up: Tensor  # (3,) what the products leave out of b_3


class HeldFlight(HeldRate):
    """What :func:`quadrotor_rate` gives while an action is held: ``gain * products + offset``.

    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> HeldFlight(torch.zeros(4), QuadrotorBody())(level)[3:6]
    tensor([ 0.0000,  0.0000, -9.8100])
    """

    def __init__(self, action: Tensor, body: QuadrotorBody, wind: Tensor | None = None) -> None:
        self.body = body
        self.tables = tables = _tables(body, action.dtype, action.device)
        lift = action[..., :1] / body.mass
        zero = torch.zeros_like(lift)
        push = torch.cat([zero, zero, lift], -1) + tables.weight
        push = push if wind is None else push + wind
        still = zero.expand(*zero.shape[:-1], 4)
        one = torch.ones_like(lift).expand(*zero.shape[:-1], 7)
        self.gain = torch.cat([lift.expand(*lift.shape[:-1], 3), one], -1)
        self.offset = torch.cat([push, still, action[..., 1:] * tables.inverse], -1)

    def __call__(self, state: Tensor) -> Tensor:
        """Return the rate of change ``(*B, 13)``."""
        return self._rate(state, self._sums(state))

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        tables, sums = self.tables, self._sums(state)
        slope = (state[..., 6:] @ tables.slope).unflatten(-1, (10, 7)) * self.gain.unsqueeze(-1)
        rest = slope @ through[..., 6:, :]
        rest[..., :3, -4] += (sums[..., :3] + tables.up) / self.body.mass  # b_3 / m
        rest[..., 7:, -3:] += tables.inverse.diag()
        return self._rate(state, sums), torch.cat([through[..., 3:6, :], rest], -2)

    def finish(self, state: Tensor) -> Tensor:
        return unit(state)

    def _sums(self, state: Tensor) -> Tensor:
        """Return the sums of products that b_3, q' and w' are made of, ``(*B, 10)``."""
        tables = self.tables
        pairs = state.index_select(-1, tables.first) * state.index_select(-1, tables.second)
        # Not a matrix product: a flight shall be the same to the bit in any batch.
        return (pairs.reshape(*pairs.shape[:-1], 3, 10) * tables.factor).sum(-2)

    def _rate(self, state: Tensor, sums: Tensor) -> Tensor:
        return torch.cat([state[..., 3:6], torch.addcmul(self.offset, self.gain, sums)], -1)


def quadrotor_rate(
    state: Tensor, action: Tensor, body: QuadrotorBody, wind: Tensor | None = None
) -> Tensor:
    r"""Return the rate of change of states, ``(*B, 13)``.

    .. math:: r' = v,\quad v' = g + w + \tfrac{T}{m} b_3(q),\quad
              q' = \tfrac12 q \otimes (\omega, 0),\quad
              \omega' = J^{-1} (M - \omega \times J \omega)

    Args:
        state: position r (m), velocity v (m/s), quaternion q (scalar-last), body rate
            :math:`\omega` (rad/s), ``(*B, 13)``.
        action: thrust T (N) and moments M (N m), ``(*B, 4)``.
        body: the quadrotor.
        wind: a further acceleration w (m/s^2), ``(*B, 3)``.

    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> body = QuadrotorBody()
    >>> quadrotor_rate(level, torch.tensor([2 * body.hover_thrust, 0, 0, 0]), body)[3:6]
    tensor([0.0000, 0.0000, 9.8100])
    """
    state, action = aligned(state, action)
    return HeldFlight(action, body, wind)(state)


def quadrotor_step(
    state: Tensor, action: Tensor, dt: float, substeps: int, body: QuadrotorBody
) -> Tensor:
    """Return the last state ``(*B, 13)`` of :func:`quadrotor_path`."""
    return quadrotor_path(state, action, dt, substeps, body)[-1]


def quadrotor_path(
    state: Tensor,
    action: Tensor,
    dt: float,
    substeps: int,
    body: QuadrotorBody,
    wind: Tensor | None = None,
) -> Tensor:
    """Fly for ``dt`` s by N Runge-Kutta steps, the action held; return the states ``(N, *B, 13)``.

    The quaternion is scaled back to length 1 at the end; before that it is off by the error of the
    integration.

    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> fallen = quadrotor_path(level, torch.zeros(4), 1.0, 2, QuadrotorBody())
    >>> fallen[:, 2]
    tensor([-1.2263, -4.9050])
    """
    state, action = aligned(state, action)
    path = runge_kutta_path(HeldFlight(action, body, wind), state, dt, substeps)
    path[-1] = unit(path[-1])
    return torch.stack(path)


def unit(state: Tensor) -> Tensor:
    """Scale the quaternions in states ``(*B, 13)`` to length 1."""
    turned = roma.quat_normalize(state[..., 6:10])
    return torch.cat([state[..., :6], turned, state[..., 10:]], -1)


def aligned(state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Give states ``(*B, 13)`` and actions ``(*B, 4)`` the same batch shape and type."""
    if state.shape[:-1] == action.shape[:-1] and state.dtype == action.dtype:
        return state, action
    batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
    dtype = torch.promote_types(state.dtype, action.dtype)
    return state.expand(*batch, 13).to(dtype), action.expand(*batch, 4).to(dtype)


@cached(maxsize=64)
def _tables(body: QuadrotorBody, dtype: torch.dtype, device: torch.device) -> _Tables:
    x, y, z, w, p, q, r = range(7)  # quaternion (x, y, z, w), body rate (p, q, r)
    along_x, along_y, along_z = body.inertia
    sums: list[list[tuple[int, int, float]]] = [
        [(x, z, 2.0), (y, w, 2.0)],  # b_3
        [(y, z, 2.0), (x, w, -2.0)],
        [(x, x, -2.0), (y, y, -2.0)],  # less the 1, which the offset holds
        [(w, p, 0.5), (z, q, -0.5), (y, r, 0.5)],  # q'
        [(z, p, 0.5), (w, q, 0.5), (x, r, -0.5)],
        [(y, p, -0.5), (x, q, 0.5), (w, r, 0.5)],
        [(x, p, -0.5), (y, q, -0.5), (z, r, -0.5)],
        [(q, r, (along_y - along_z) / along_x)],  # w', less what the moments add
        [(r, p, (along_z - along_x) / along_y)],
        [(p, q, (along_x - along_y) / along_z)],
    ]
    with torch.inference_mode(False):  # what is cached must also serve training
        first, second = torch.zeros(2, 3, 10, dtype=torch.int64)
        factor, slope = (torch.zeros(size, dtype=torch.float64) for size in ((3, 10), (7, 10, 7)))
        for row, products in enumerate(sums):
            for place, (i, j, value) in enumerate(products):
                first[place, row], second[place, row], factor[place, row] = i, j, value
                slope[j, row, i] += value
                slope[i, row, j] += value
        inertia = torch.tensor(body.inertia, dtype=torch.float64)
        weight = torch.tensor([0.0, 0.0, -body.gravity], dtype=torch.float64)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        floats = (factor, slope.flatten(1), 1 / inertia, weight, up)
        indices = (6 + index.flatten().to(device) for index in (first, second))
        return _Tables(*indices, *(table.to(device, dtype) for table in floats))


class Quadrotor(KnownDynamics):
    """A rigid quadrotor over one control tick with constant action; see :func:`quadrotor_rate`.

    States are position (m), velocity (m/s), quaternion (scalar-last) and body rate (rad/s), S = 13
    and D = 12; actions are thrust (N) and moments (N m), which the motors are assumed to produce;
    the plant applies the limits, :func:`~afm_rl.spaces.airframe.within_motors`. Quaternions keep
    length 1.

    Args:
        body: the quadrotor, a Crazyflie if None.

    >>> import torch
    >>> model = Quadrotor()
    >>> level = torch.zeros(4, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> ahead, by_state, by_action = model.linearise(level, torch.zeros(4, 4))
    >>> ahead.shape, by_state.shape, by_action.shape
    (torch.Size([4, 13]), torch.Size([4, 13, 13]), torch.Size([4, 13, 4]))
    """

    extrapolates = True

    @options("dynamics")
    def __init__(
        self,
        body: QuadrotorBody | None = None,
        dt: Annotated[Positive, "control tick, s"] = 0.05,
        substeps: Annotated[Count, "Runge-Kutta steps per tick, accurate to 1e-6 in flight"] = 1,
        noise_std: Annotated[
            Positive | Sequence[Positive],
            "standard deviation of a prediction, m, m/s, rad and rad/s",
        ] = 1e-3,
    ) -> None:
        body = check_body(body)
        step = partial(quadrotor_step, dt=dt, substeps=substeps, body=body)
        super().__init__(step, RigidBodySpace(), 4, noise_std)
        self.body, self.dt, self.substeps = body, dt, substeps

    @closed_form
    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        state, action = aligned(state, action)
        rate = HeldFlight(action, self.body)
        return runge_kutta_linearised(rate, state, 4, self.dt, self.substeps)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        return jacobian_of_linearised(self, state, action)


def check_body(body: QuadrotorBody | None) -> QuadrotorBody:
    """Return the quadrotor, by default a Crazyflie; refuse what is none.

    >>> check_body(None).mass
    0.03
    """
    if body is None:
        return QuadrotorBody()
    if not isinstance(body, QuadrotorBody):
        raise ConfigurationError(f"body={body!r}: expected a QuadrotorBody")
    return body
