"""The quadrotor's nominal dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from torch import Tensor

from afm_rl.dynamics.base import jacobian_of_linearised
from afm_rl.dynamics.known import KnownDynamics
from afm_rl.dynamics.quadrotor_equations import HeldFlight, aligned, quadrotor_step
from afm_rl.dynamics.runge_kutta import runge_kutta_linearised
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.spaces.airframe import QuadrotorBody
from afm_rl.spaces.manifold import RigidBodySpace


class Quadrotor(KnownDynamics):
    """A rigid quadrotor over one control tick, the action held; see :func:`quadrotor_rate`.

    States are position (m), velocity (m/s), quaternion (scalar-last) and body rate (rad/s), S = 13
    and D = 12; actions are thrust (N) and moments (N m) that the motors are taken to give:
    :func:`~afm_rl.spaces.airframe.saturate` is the plant's affair. Quaternions stay of length 1.

    Args:
        body: the quadrotor, a Crazyflie if None.
        dt: control tick (s).
        substeps: Runge-Kutta steps per tick; one is accurate to 1e-6 in ordinary flight.
        noise_std: standard deviation of the model's own error per tick, one number or one per
            tangent coordinate (m, m/s, rad, rad/s, three of each).

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> import torch
    >>> model = Quadrotor()
    >>> level = torch.zeros(4, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> ahead, by_state, by_action = model.linearise(level, torch.zeros(4, 4))
    >>> ahead.shape, by_state.shape, by_action.shape
    (torch.Size([4, 13]), torch.Size([4, 13, 13]), torch.Size([4, 13, 4]))
    """

    extrapolates = True

    def __init__(
        self,
        body: QuadrotorBody | None = None,
        dt: float = 0.05,
        substeps: int = 1,
        noise_std: float | Sequence[float] = 1e-3,
    ) -> None:
        body = check_body(body)
        dt = check_number("dynamics.dt", dt, low=0.0, open_low=True)
        check_count("dynamics.substeps", substeps)
        step = partial(quadrotor_step, dt=dt, substeps=substeps, body=body)
        super().__init__(step, RigidBodySpace(), 4, noise_std)
        self.body, self.dt, self.substeps = body, dt, substeps

    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        state, action = aligned(state, action)
        rate = HeldFlight(action, self.body)
        return runge_kutta_linearised(rate, state, 4, self.dt, self.substeps)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        return jacobian_of_linearised(self, state, action)


def check_body(body: QuadrotorBody | None) -> QuadrotorBody:
    """Return the quadrotor, by default a Crazyflie.

    Raises:
        ConfigurationError: if it is none.

    >>> check_body(None).mass
    0.03
    """
    if body is None:
        return QuadrotorBody()
    if not isinstance(body, QuadrotorBody):
        raise ConfigurationError(f"body={body!r}: expected a QuadrotorBody")
    return body
