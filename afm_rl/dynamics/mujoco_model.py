"""What a MuJoCo model is read from, and whether it can be simulated."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from afm_rl.dynamics.mujoco_space import MuJoCoSpace
from afm_rl.errors import ConfigurationError, check_number

try:
    import mujoco
except ImportError:  # an extra
    mujoco = None

HUGE = 1e9  # MuJoCo resets a simulation that holds larger numbers


def read_model(source: Any) -> tuple[Any, int]:
    """Return a copy of the ``MjModel`` in a source, and the simulation steps per action.

    Args:
        source: see :class:`MuJoCoDynamics`.

    Raises:
        ConfigurationError: if there is no model in it, none with actuators, or none that moves.
    """
    if mujoco is None:
        raise ConfigurationError(
            "dynamics=mujoco: the package mujoco is missing; install afm-rl[mujoco]"
        )
    skip, inner = 1, getattr(source, "unwrapped", source)
    if isinstance(source, str | Path):
        found = _parse(source)
    elif isinstance(getattr(inner, "model", inner), mujoco.MjModel):  # gymnasium, or plain
        found, skip = getattr(inner, "model", inner), getattr(inner, "frame_skip", 1)
    elif hasattr(source, "physics"):  # dm_control
        found = source.physics.model.ptr
        skip = round(source.control_timestep() / source.physics.timestep())
    else:
        raise ConfigurationError(
            f"dynamics.model={source!r}: expected an MJCF file or string, an mjModel, or a MuJoCo "
            "environment of gymnasium or dm_control"
        )
    name = f"dynamics.model={str(source)[:80]!r}"
    if found.nu == 0:
        raise ConfigurationError(f"{name}: expected actuators, found none")
    check_numbers(name, found)
    return copy.copy(found), skip


def check_numbers(name: str, model: Any) -> None:
    """Check the time step and the bodies of an ``MjModel``.

    Raises:
        ConfigurationError: for a step that is not above 0, and masses that nothing can move.
    """
    check_number(f"{name}: timestep", float(model.opt.timestep), low=0.0, open_low=True)
    for kind, values in (("mass", model.body_mass), ("inertia", model.body_inertia)):
        for body, most in enumerate(np.abs(values).reshape(model.nbody, -1).max(-1)):
            if not most < HUGE:
                raise ConfigurationError(
                    f"{name}: body {model.body(body).name or body!r} has {kind} {most:g}; expected "
                    f"a finite number below {HUGE:g}"
                )


def _parse(source: str | Path) -> Any:
    text = str(source)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjModel.from_xml_string(text)
        if not Path(text).is_file():
            raise ConfigurationError(f"dynamics.model={text}: no such file")
        return mujoco.MjModel.from_xml_path(text)
    except ConfigurationError:
        raise
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(f"dynamics.model={text[:80]!r}: {reason}") from error


def space_of(model: Any) -> MuJoCoSpace:
    """Return the state space of an ``MjModel``."""
    angles, quaternions = [], []
    for kind, first, limited in zip(
        model.jnt_type, model.jnt_qposadr, model.jnt_limited, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_HINGE and not limited:
            angles.append(int(first))
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            quaternions.append(int(first))
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            quaternions.append(int(first) + 3)
    return MuJoCoSpace(model.nq + model.nv + model.na, angles, quaternions)


def state_names(model: Any) -> list[str]:
    """Name positions ``q_JOINT``, velocities ``v_JOINT`` and activations ``w_k``."""
    places, turn, rates = ("_x", "_y", "_z"), ("_qw", "_qx", "_qy", "_qz"), ("_wx", "_wy", "_wz")
    positions, velocities = [], []
    ends: tuple[str, ...]
    moves: tuple[str, ...]
    for joint, kind in enumerate(model.jnt_type):
        name = model.joint(joint).name or str(joint)
        ends, moves = ("",), ("",)  # of a slide or a hinge
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            ends, moves = turn, rates
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            ends, moves = (*places, *turn), (*places, *rates)
        positions += [f"q_{name}{end}" for end in ends]
        velocities += [f"v_{name}{end}" for end in moves]
    return [*positions, *velocities, *(f"w_{k}" for k in range(model.na))]


def actuator_names(model: Any) -> list[str]:
    """Return the names of actuators, those without one by the joint that they drive, or ``a_k``."""
    names: list[str] = []
    for k in range(model.nu):
        name = model.actuator(k).name
        if not name and model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT:
            name = model.joint(model.actuator_trnid[k, 0]).name
        names.append(name if name and name not in names else f"a_{k}")
    return names
