"""The quadrotor in RotorPy: a plant that others wrote, with motor lag, rotor drag and wind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.quadrotor.env import CrazyflieTrack
from afm_rl.envs.quadrotor.simulation import QuadrotorSimulation
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import InertiaFactor, MassFactor, MotorEfficiency, Payload, Wind
from afm_rl.spaces.airframe import QuadrotorBody, mix, unmix

try:
    import roma  # noqa: F401  # RotorPy continues without these two, and fails when it steps
    import torchdiffeq  # noqa: F401
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams
except ImportError:  # an extra
    quad_params = None


def rotorpy_crazyflie() -> QuadrotorBody:
    """Return the body of RotorPy's Crazyflie, as far as our model describes it.

    Raises:
        ConfigurationError: if RotorPy is not installed.
    """
    known = _parameters()
    arms = list(known["rotor_pos"].values())
    one, two, three, four = (math.degrees(math.atan2(y, x)) for x, y, _ in arms)
    return QuadrotorBody(
        mass=known["mass"],
        inertia=(known["Ixx"], known["Iyy"], known["Izz"]),
        arm=math.hypot(*arms[0]),
        k_t=known["k_eta"],
        k_d=known["k_m"],
        rotor_speed=known["rotor_speed_max"],
        motors=(one, two, three, four),
    )


@dataclass(frozen=True)
class RotorPySimulation(QuadrotorSimulation):
    """Quadrotors of which RotorPy computes what happens in a control tick.

    Changes of mass, inertia, load and motors, and the wind, are changes of RotorPy's vehicle; all
    other regimes act on the wrench before motors are asked for it.
    """

    def begin(self, mission: TensorDictBase, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return the state at the beginning of flights, with rotors that carry the weight."""
        state = super().begin(mission, dtype)
        speed = math.sqrt(self.body.hover_thrust / (4 * self.body.k_t))
        carried = torch.zeros_like(state["pose"][..., :4])
        carried[..., 0] = self.body.hover_thrust
        return {**state, "rotors": torch.full_like(carried, speed), "wrench": carried}

    def flown(
        self, data: TensorDictBase, action: Tensor, parameters: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        pose, (of_action, changes) = data["pose"], self._split(parameters)
        effective = self.effect(data, action, of_action, noise)
        asked = (unmix(effective, self.body).clamp_min(0.0) / self.body.k_t).sqrt()

        rows = pose.reshape(-1, 13).double()
        x, v, q, w = rows.split([3, 3, 4, 3], -1)
        changes = {name: value.reshape(len(rows), -1).double() for name, value in changes.items()}
        state = {"x": x, "v": v, "q": q, "w": w, "wind": changes["Wind"]}
        state["rotor_speeds"] = data["rotors"].reshape(-1, 4).double()
        control = {"cmd_motor_speeds": asked.reshape(-1, 4).double()}
        vehicle, every = self._vehicle(state, changes), torch.arange(len(rows))
        path, turned = [], []
        # It adds noise of standard deviation zero, drawn from the numbers of all of torch.
        with torch.random.fork_rng(devices=[]):
            for _ in range(self.substeps):
                state = vehicle.step(state, control, self.dt / self.substeps, every)
                path.append(torch.cat([state[name] for name in ("x", "v", "q", "w")], -1))
                turned.append(state["rotor_speeds"])
        flown = torch.stack(path).reshape(self.substeps, *pose.shape).to(pose.dtype)
        speeds = torch.stack(turned).reshape(self.substeps, *action.shape).to(pose.dtype)
        given = mix(self.body.k_t * speeds.square().mean(0), self.body)
        return flown, {"rotors": speeds[-1], "wrench": given}

    def _split(self, parameters: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the parameters without changes of the plant, and these by the family's name."""
        names, left, changes = self.regime.names, parameters.clone(), {}
        for family in (MotorEfficiency, Payload, MassFactor, InertiaFactor, Wind):
            nominal = parameters.new_tensor(family.identity)
            changes[family.__name__] = nominal.expand(*parameters.shape[:-1], -1)
            if set(family.names) <= set(names):
                columns = [names.index(name) for name in family.names]
                changes[family.__name__] = parameters[..., columns]
                left[..., columns] = nominal
        return left, changes

    def _vehicle(self, state: Mapping[str, Tensor], changes: Mapping[str, Tensor]) -> Any:
        """Return RotorPy's vehicles, changed."""
        count = len(state["x"])
        nominal = _nominal(count)
        params = BatchedMultirotorParams.__new__(BatchedMultirotorParams)
        vars(params).update(vars(nominal))
        share, x, y = changes["Payload"].split(1, -1)
        params.mass = nominal.mass * changes["MassFactor"] * (1 + share)
        params.weight = nominal.weight * changes["MassFactor"] * (1 + share)
        params.inertia = nominal.inertia * changes["InertiaFactor"].unsqueeze(-1)
        params.inv_inertia = nominal.inv_inertia / changes["InertiaFactor"].unsqueeze(-1)
        params.k_eta = nominal.k_eta * changes["MotorEfficiency"]
        params.k_m = nominal.k_m * changes["MotorEfficiency"]
        centre = share / (1 + share) * torch.cat([x, y, torch.zeros_like(x)], -1)
        params.rotor_geometry = nominal.rotor_geometry - centre.unsqueeze(-2)
        hats = BatchedMultirotor.hat_map(params.rotor_geometry.reshape(-1, 3))
        params.rotor_geometry_hat_maps = hats.reshape(3, 3, count, 4).permute(2, 0, 1, 3)
        return BatchedMultirotor(params, count, state, state["x"].device, integrator="rk4")


class RotorPyTrack(CrazyflieTrack):
    """:class:`CrazyflieTrack` with RotorPy (version 3) as the plant.

    Its Crazyflie has motors that lag by 72 ms, rotors with drag, and wind that acts through that
    drag: ``wind_x``, ``wind_y`` and ``wind_z`` are its speed (m/s) here. Masses, loads, moments of
    inertia and motors change in RotorPy's vehicle itself. RotorPy computes on the CPU. Observation
    and action are those of :class:`CrazyflieTrack`. Two entries more:

    ========== ============ =================================================================
    ``wrench`` ``(*B, 4)``  what healthy motors give at the speeds that the rotors had in the
                            last tick, its mean (N, N m): for ``reported`` of a robot
    ``rotors`` ``(*B, 4)``  these speeds at the end of the tick (rad/s)
    ========== ============ =================================================================

    Args:
        tracks: see :class:`CrazyflieTrack`.
        settings: further arguments of :class:`CrazyflieTrack`, but ``body``.

    Raises:
        ConfigurationError: for a setting that cannot be used, or if RotorPy is not installed.
    """

    plant = RotorPySimulation

    def __init__(self, tracks: Any = "circle_2m_0.8mps", **settings: Any) -> None:
        super().__init__(tracks, body=rotorpy_crazyflie(), **settings)


def _parameters() -> dict[str, Any]:
    if quad_params is None:
        raise ConfigurationError(
            "robot=quadrotor_rotorpy: the package rotorpy is missing; install afm-rl[rotorpy]"
        )
    return quad_params


@lru_cache(maxsize=16)
def _nominal(count: int) -> Any:
    """Return RotorPy's parameters of ``count`` Crazyflies."""
    with torch.inference_mode(False):
        return BatchedMultirotorParams([_parameters()] * count, count, torch.device("cpu"))
