"""A ground robot in MuJoCo: four wheels, skid steering, contacts with friction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.dynamics.mujoco_model import changed_model
from afm_rl.imports import needs
from afm_rl.options import Natural, Positive, options
from afm_rl.regimes import Physics

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
RADIUS = 0.098  # m, of a wheel
STEP = 0.01  # s, of the simulation


@options("dynamics")
def skid_steer(
    dt: Annotated[float, Ge(STEP), "time of an action, s, a multiple of 0.01 s"] = 0.2,
    noise_std: Annotated[
        Positive | Sequence[Positive],
        "standard deviation of a prediction, positions and velocities",
    ] = (2e-3, 2e-2),
    threads: Annotated[Natural, "additional threads for simulation"] = 0,
    width: Annotated[Positive, "width of a non-skidding axle with the same turn rate, m"] = 0.9,
) -> MuJoCoDynamics:
    r"""Return a small robot with four wheels; actions are v (m/s) and omega (rad/s).

    .. math:: w_{left} = (v - \omega b / 2) / r, \qquad w_{right} = (v + \omega b / 2) / r

    are the commanded speeds of the wheels' servos, with the radius r and a width b that is
    larger than the robot's, because its wheels skid in turns. The state begins with x, y (m) and
    theta (rad); then height, pitch, roll, the angles of the wheels, and the velocities of all of
    these.

    >>> import torch
    >>> robot = skid_steer()
    >>> robot(torch.zeros(20), torch.tensor([1.0, 0.0]))[0] > 0.1
    tensor(True)
    """
    mujoco = needs("robot=ugv_mujoco", "mujoco", "mujoco")
    skip = round(dt / STEP)
    turn = width / 2 / RADIUS
    mix = [[1 / RADIUS, -turn], [1 / RADIUS, turn]] * 2
    return MuJoCoDynamics(
        mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("skid_steer.xml"))),
        skip,
        noise_std,
        threads,
        changed_wheels,
        dict(zip(WheelPhysics.names, WheelPhysics.identity, strict=True)),
        (mix, 0.0),
    )


class WheelPhysics(Physics):
    """Other physics of the robot on wheels.

    In addition to those of :class:`~afm_rl.regimes.Physics`: the position of the ``payload``,
    ``payload_x`` and ``payload_y`` (m, from the middle); ``wheel_FRONT_LEFT`` and so on, factors of
    the commanded speed (-1: reversed; 0: blocked); ``tyre_FRONT_LEFT`` and so on, factors of
    its radius.

    >>> flat = WheelPhysics().encode({"tyre_rear_left": 0.8})
    >>> len(flat)
    18
    """

    names = (
        *Physics.names,
        *("payload_x", "payload_y"),
        *(f"wheel_{name}" for name in WHEELS),
        *(f"tyre_{name}" for name in WHEELS),
    )
    identity = (*Physics.identity, *[0.0] * 2, *[1.0] * 8)
    limits = {**Physics.limits, **dict.fromkeys(names[-4:], (0.5, 1.2))}


def changed_wheels(model: Any, row: tuple[float, ...]) -> Any:
    """Return a copy of the robot's model with other physics, a row of ``WheelPhysics.names``."""
    import mujoco

    value = dict(zip(WheelPhysics.names, row, strict=True))
    found = changed_model(model, row[: len(Physics.names)])
    base = model.body("base").id
    load = value["payload"] * model.body_mass.sum() * value["mass"] / found.body_mass[base]
    found.body_ipos[base, :2] += load * value["payload_x"], load * value["payload_y"]
    for name in WHEELS:
        found.actuator_gainprm[model.actuator(name).id, 0] *= value[f"wheel_{name}"]
        found.geom_size[model.geom(name).id, ::2] *= value[f"tyre_{name}"]
    mujoco.mj_setConst(found, mujoco.MjData(found))
    return found
