"""A quadrotor's parameters, its mixer, and what its motors can do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number


@dataclass(frozen=True)
class QuadrotorBody:
    r"""A quadrotor; by default a Crazyflie 2 in plus configuration.

    Actions are a wrench :math:`u = (T, M_x, M_y, M_z)` in N and N m, in the body frame. Motors 1
    to 4 stand at the distance ``arm`` from the centre and push with
    :math:`F_i = k_t \Omega_i^2`; the drag :math:`k_d \Omega_i^2` of motors 1 and 3 turns the body
    about +z, that of motors 2 and 4 about -z.

    Args:
        mass: mass (kg).
        inertia: moments of inertia about x, y and z (kg m^2).
        arm: distance of the motors from the centre (m).
        k_t: thrust coefficient (N s^2/rad^2).
        k_d: drag coefficient (N m s^2/rad^2).
        rotor_speed: highest speed of a rotor (rad/s).
        gravity: acceleration of free fall (m/s^2).
        motors: direction :math:`\theta_i` of each motor from the centre (degrees), from +x to +y.

    Raises:
        ConfigurationError: for a value that cannot be used.

    >>> round(QuadrotorBody().max_thrust, 3)
    0.575
    """

    mass: float = 0.03
    inertia: tuple[float, float, float] = (1.43e-5, 1.43e-5, 2.89e-5)
    arm: float = 0.046
    k_t: float = 2.3e-8
    k_d: float = 7.8e-11
    rotor_speed: float = 2500.0
    gravity: float = 9.81
    motors: tuple[float, float, float, float] = (0.0, 90.0, 180.0, 270.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "inertia":
                row = _row("inertia", value, "three moments of inertia (kg m^2)", 3, low=0.0)
                object.__setattr__(self, "inertia", row)
            elif field.name == "motors":
                row = _row("motors", value, "the directions of four motors (degrees)", 4)
                object.__setattr__(self, "motors", row)
            else:
                above = field.name != "gravity"
                check_number(f"body.{field.name}", value, low=0.0, open_low=above)

    @property
    def levers(self) -> tuple[list[float], list[float]]:
        """Moments about x and about y (N m) of a thrust of 1 N of each motor."""
        angles = [math.radians(angle) for angle in self.motors]
        # Rounded: the sine of 180 degrees is zero.
        about_x = [self.arm * round(math.sin(angle), 15) for angle in angles]
        return about_x, [-self.arm * round(math.cos(angle), 15) for angle in angles]

    @property
    def max_force(self) -> float:
        """Largest thrust of one motor (N)."""
        return self.k_t * self.rotor_speed**2

    @property
    def max_thrust(self) -> float:
        """Largest thrust of all motors (N)."""
        return 4 * self.max_force

    @property
    def hover_thrust(self) -> float:
        """Thrust that carries the weight (N)."""
        return self.mass * self.gravity

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lowest and highest value of each action component; not all of them go together."""
        yaw = 2 * self.k_d / self.k_t * self.max_force
        low, high = (
            [sum(clip(lever, 0.0) for lever in row) * self.max_force for row in self.levers]
            for clip in (min, max)
        )
        return (0.0, *low, -yaw), (self.max_thrust, *high, yaw)


def _row(
    name: str, given: Sequence[float], expected: str, size: int, low: float = -math.inf
) -> tuple[float, ...]:
    """Return numbers as a tuple, whatever sequence was given: bodies are keys of caches."""
    if not isinstance(given, (tuple, list)) or len(given) != size:
        raise ConfigurationError(f"body.{name}={given!r}: expected {expected}")
    return tuple(
        float(check_number(f"body.{name}", value, low=low, open_low=True)) for value in given
    )


def mix(forces: Tensor, body: QuadrotorBody) -> Tensor:
    r"""Return the wrench ``(*B, 4)`` of motor forces ``(*B, 4)`` in N.

    .. math:: T = \sum_i F_i,\quad M_x = L \sum_i F_i \sin \theta_i,\quad
              M_y = -L \sum_i F_i \cos \theta_i,\quad
              M_z = \tfrac{k_d}{k_t} (F_1 - F_2 + F_3 - F_4)

    >>> mix(torch.tensor([0.1, 0.2, 0.1, 0.0]), QuadrotorBody()).round(decimals=4)
    tensor([0.4000, 0.0092, 0.0000, 0.0000])
    """
    return _through(_mixers(body, forces.dtype, forces.device)[0], forces)


def unmix(action: Tensor, body: QuadrotorBody) -> Tensor:
    """Return the motor forces ``(*B, 4)`` in N that make up wrenches ``(*B, 4)``.

    >>> unmix(torch.tensor([0.4, 0.0, 0.0, 0.0]), QuadrotorBody())
    tensor([0.1000, 0.1000, 0.1000, 0.1000])
    """
    return _through(_mixers(body, action.dtype, action.device)[1], action)


def within_motors(action: Tensor, body: QuadrotorBody) -> Tensor:
    r"""Return the wrench ``(*B, 4)`` that the motors give when they are asked for ``action``.

    .. math:: \mathrm{mix}(\mathrm{clamp}(\mathrm{mix}^{-1} u, 0, F_\mathrm{max}))

    A wrench within their means is kept to the bit.

    >>> within_motors(torch.tensor([0.8, 0.0, 0.0, 0.0]), QuadrotorBody())[0]
    tensor(0.5750)
    """
    forces = unmix(action, body)
    return action + mix(forces.clamp(0.0, body.max_force) - forces, body)


def _through(matrix: Tensor, vector: Tensor) -> Tensor:
    # No matmul: a row's result must not depend on the size of the batch.
    return (matrix * vector.unsqueeze(-2)).sum(-1)


@lru_cache(maxsize=64)
def _mixers(body: QuadrotorBody, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the mixer and its inverse, ``(4, 4)`` each."""
    drag = body.k_d / body.k_t
    rows = [[1.0] * 4, *body.levers, [drag, -drag, drag, -drag]]
    with torch.inference_mode(False):  # what is cached must also serve training
        mixer = torch.tensor(rows, dtype=torch.float64, device="cpu")
        return mixer.to(device, dtype), mixer.inverse().to(device, dtype)
