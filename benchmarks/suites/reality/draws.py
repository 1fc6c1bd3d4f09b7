"""Random differences between robot and model, and the faults.

Level k is 1 (mild) or 2 (medium); level 0 is the nominal model. One robot is drawn for each
episode. `U` is uniform in [-1, 1], drawn for each body, joint, actuator or wheel.

| MuJoCo | factor | | ground robot | |
|---|---|---|---|---|
| mass and inertia | 1 + .1 k U | | radius of each wheel | x (1 + .05 k U) |
| damping, armature, friction loss | 1 + .2 k U | | track width | x (1 + .1 k U) |
| gear or servo gain | 1 + .05 k U | | lag of the speeds | .05 k s |
| friction of contacts | 1 + .15 k U | | slip | .05 k |
| gravity | tilted by k degrees, forwards or backwards | | | |

Readings have Gaussian noise with standard deviations of .001 k (m, rad) and .025 k (m/s, rad/s).
"""

from __future__ import annotations

import copy
import math
from typing import Any

import mujoco
import numpy as np

LEVELS = {"mild": 1, "medium": 2}
POSITION_NOISE, SPEED_NOISE = 0.001, 0.025  # m or rad, and per second; times the level
WHEELS = {"left": 1.0, "right": 1.0, "track": 1.0, "lag": 0.0, "slip": 0.0}  # nominal


def faults(actuators: int) -> dict[str, dict[str, float]]:
    """Return the faults of a number of actuators by name, for ``FaultVectorWrapper``.

    >>> faults(6)["swapped"]
    {'from_0': 3, 'from_3': 0}
    """
    every, other = range(actuators), actuators // 2
    return {
        "none": {},
        "reversed": {f"gain_{k}": -1.0 for k in every},
        "swapped": {"from_0": other, f"from_{other}": 0},
        "late 3": {"delay": 3},
        "half": {"gain_0": 0.5},
        "offset": {f"bias_{k}": 0.2 for k in every},
    }


def drawn_model(model: Any, row: tuple[float, ...]) -> Any:
    """Return the ``MjModel`` of a drawn robot.

    Args:
        model: the nominal model, which is not changed.
        row: level and number of the draw.
    """
    level, draw = row
    generator, drawn = np.random.default_rng(int(draw)), copy.copy(model)

    def factor(size: int, spread: float) -> np.ndarray:
        return 1 + spread * level * generator.uniform(-1, 1, size)

    mass = factor(model.nbody, 0.1)
    drawn.body_mass[:] *= mass
    drawn.body_inertia[:] *= mass[:, None]
    drawn.body_gravcomp[:] /= mass  # the nominal weight is compensated
    for part in (drawn.dof_damping, drawn.dof_armature, drawn.dof_frictionloss):
        part[:] *= factor(model.nv, 0.2)
    gear = factor(model.nu, 0.05)
    servo = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    drawn.actuator_gainprm[servo, 0] *= gear[servo]
    drawn.actuator_gear[~servo] *= gear[~servo, None]
    tilt = math.radians(level) * generator.choice([-1, 1])
    drawn.opt.gravity[:] = np.linalg.norm(model.opt.gravity) * np.array(
        [math.sin(tilt), 0.0, -math.cos(tilt)]
    )
    drawn.geom_friction[:, 0] *= factor(1, 0.15)
    mujoco.mj_setConst(drawn, mujoco.MjData(drawn))
    return drawn


def drawn_wheels(level: int, draw: int) -> list[float]:
    """Return the ground robot that is drawn, a value for each of :data:`WHEELS`."""
    left, right, track = np.random.default_rng(draw).uniform(-1, 1, 3)
    factors = [1 + 0.05 * level * left, 1 + 0.05 * level * right, 1 + 0.1 * level * track]
    return [*map(float, factors), 0.05 * level, 0.05 * level]
