"""The Furuta pendulum whose motor sign, length and tip mass are hidden.

The definition is that of github.com/simon-bachhuber/tabpfn-furuta-in-context-adaptation. A motor
turns an arm; a pendulum hangs at the arm's end, free to turn about the arm's axis. States are arm
angle, pendulum angle (0 is upright) in rad, and their speeds in rad/s; the action is a voltage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from afm_rl.spaces.manifold import Manifold, wrap_angle

SPACE = Manifold(4, angles=[0, 1])
PERIOD, STEP = 0.05, 0.002  # s: of control, of the simulation
VOLTAGE, FASTEST = 10.0, 30.0  # V; rad/s, at which speeds are cut after each period
GRAVITY, ARM, ARM_MASS, ARM_RADIUS = 9.81, 0.15, 0.15, 0.006  # m/s^2, m, kg, m
ROD_MASS, ROD_RADIUS = 0.02, 0.005  # kg, m
ARM_DAMPING, HINGE_DAMPING = 0.003, 0.001  # N m s/rad
TORQUE, BACK = 0.1 / 4, 0.1 * 0.1 / 4  # N m/V; N m s/rad, of the motor
LENGTHS, TIPS = (0.2, 0.4), (0.01, 0.05)  # m, kg
MJCF = """<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 -{gravity}">
<flag contact="disable"/></option><worldbody><body><joint name="arm" axis="0 0 1"
damping="{arm_damping}"/><geom type="capsule" fromto="0 0 0 {arm} 0 0" size="{arm_radius}"
mass="{arm_mass}"/><body pos="{arm} 0 0"><joint name="pendulum" axis="1 0 0"
damping="{hinge_damping}"/><geom type="capsule" fromto="0 0 0 0 0 {length}" size="{rod_radius}"
mass="{rod_mass}"/><geom type="sphere" pos="0 0 {length}" size="{ball}" mass="{tip}"/></body></body>
</worldbody><actuator><general joint="arm" gainprm="{gain}" biastype="affine"
biasprm="0 0 -{back}" ctrllimited="true" ctrlrange="-{voltage} {voltage}"/></actuator></mujoco>"""


class Plant(NamedTuple):
    """The hidden parameters: length (m), tip mass (kg), and the sign of the motor."""

    length: float
    tip: float
    sign: int


def drawn(generator: np.random.Generator) -> Plant:
    """Return a random plant.

    >>> found = drawn(np.random.default_rng(900))
    >>> LENGTHS[0] < found.length < LENGTHS[1], found.sign in (-1, 1)
    (True, True)
    """
    length, tip = generator.uniform(*LENGTHS), generator.uniform(*TIPS)
    return Plant(length, tip, int(generator.choice([-1, 1])))


class Simulated:
    """Pendulums in MuJoCo, side by side; each can change while it moves.

    Args:
        plants: one for each pendulum.
        starts: their first states ``(B, 4)``.
    """

    def __init__(self, plants: Sequence[Plant], starts: np.ndarray) -> None:
        self.models = [model_of(plant) for plant in plants]
        self.data = [mujoco.MjData(model) for model in self.models]
        for data, start in zip(self.data, starts, strict=True):
            data.qpos[:], data.qvel[:] = start[:2], start[2:]

    def change(self, row: int, plant: Plant) -> None:
        """Replace a pendulum; angles and speeds stay."""
        self.models[row], old = model_of(plant), self.data[row]
        self.data[row] = mujoco.MjData(self.models[row])
        self.data[row].qpos[:], self.data[row].qvel[:] = old.qpos, old.qvel

    @property
    def states(self) -> Tensor:
        """Angles within half a turn, and speeds; ``(B, 4)``."""
        rows = np.stack([np.concatenate([data.qpos, data.qvel]) for data in self.data])
        state = torch.as_tensor(rows)
        return torch.cat([wrap_angle(state[:, :2]), state[:, 2:]], 1)

    def step(self, voltages: Tensor, pushes: Sequence[float]) -> Tensor:
        """Return the states after a period of these voltages ``(B, 1)`` and torques (N m)."""
        rows = zip(self.models, self.data, voltages.tolist(), pushes, strict=True)
        for model, data, voltage, push in rows:
            data.ctrl[:], data.qfrc_applied[1] = voltage, push
            mujoco.mj_step(model, data, nstep=round(PERIOD / STEP))
            data.qvel[:] = data.qvel.clip(-FASTEST, FASTEST)
        return self.states


def model_of(plant: Plant) -> mujoco.MjModel:
    """Return the MuJoCo model of a plant."""
    sizes = {"step": STEP, "gravity": GRAVITY, "arm": ARM, "arm_mass": ARM_MASS}
    sizes |= {"arm_radius": ARM_RADIUS, "arm_damping": ARM_DAMPING, "rod_mass": ROD_MASS}
    sizes |= {"rod_radius": ROD_RADIUS, "hinge_damping": HINGE_DAMPING, "voltage": VOLTAGE}
    sizes |= {"length": plant.length, "tip": plant.tip, "ball": ball(plant.tip)}
    sizes |= {"gain": plant.sign * TORQUE, "back": BACK}
    return mujoco.MjModel.from_xml_string(MJCF.format(**sizes))


def ball(tip):
    """Return the radius of the tip (m), a mass or a tensor of them (kg)."""
    return 0.02 * (tip / 0.05) ** (1 / 3)


def capsule(mass: float, radius: float, length):
    """Return a capsule's moments of inertia about its middle: across and along its axis."""
    sphere = mass / (1 + 0.75 * length / radius)  # both ends together
    rod = mass - sphere
    across = rod * (radius**2 / 4 + length**2 / 12)
    across = across + sphere * (0.4 * radius**2 + length**2 / 4 + 0.375 * length * radius)
    return across, rod * radius**2 / 2 + sphere * 0.4 * radius**2


ARM_INERTIA = capsule(ARM_MASS, ARM_RADIUS, ARM)[0] + ARM_MASS * ARM**2 / 4


def step(state: Tensor, voltage: Tensor, physics: Tensor, substeps: int = 2) -> Tensor:
    r"""Return states ``(*B, 4)`` after a period, by Runge-Kutta steps of Lagrange's equations.

    With :math:`J, J_z` the pendulum's inertia about the hinge and its own axis, S its first moment
    and r the arm's length,

    .. math::
        (I + m r^2 + J s^2 + J_z c^2)\,\ddot\phi - r S c\,\ddot\alpha &=
            k V - b\,\dot\phi - 2 (J - J_z)\,s c\,\dot\alpha\dot\phi - r S s\,\dot\alpha^2 \\
        J\,\ddot\alpha - r S c\,\ddot\phi &=
            (J - J_z)\,s c\,\dot\phi^2 + g S s - d\,\dot\alpha

    where :math:`s = \sin\alpha, c = \cos\alpha`.

    Args:
        state: arm angle, pendulum angle, and their speeds.
        voltage: held, ``(*B, 1)``.
        physics: length (m) and tip mass (kg), ``(*B, 2)``.
        substeps: Runge-Kutta steps of the period.
    """
    length, tip = physics.unbind(-1)
    across, along = capsule(ROD_MASS, ROD_RADIUS, length)
    round_tip = 0.4 * tip * ball(tip) ** 2
    hinge = across + ROD_MASS * length**2 / 4 + tip * length**2 + round_tip
    spread = hinge - along - round_tip
    still = ARM_INERTIA + (ROD_MASS + tip) * ARM**2 + along + round_tip
    moment = (ROD_MASS / 2 + tip) * length
    arm, weight = ARM * moment, GRAVITY * moment
    drive, drag = TORQUE * voltage[..., 0], ARM_DAMPING + BACK

    def rates(angle: Tensor, turn: Tensor, swing: Tensor) -> tuple[Tensor, Tensor]:
        s, c = angle.sin(), angle.cos()
        lever, twist = arm * c, spread * s
        bend = twist * c * turn
        first = drive - drag * turn - (2 * bend + arm * s * swing) * swing
        second = bend * turn + weight * s - HINGE_DAMPING * swing
        whole = still + twist * s
        size = whole * hinge - lever * lever
        return (hinge * first + lever * second) / size, (lever * first + whole * second) / size

    phi, angle, turn, swing = state.unbind(-1)
    h = PERIOD / substeps
    for _ in range(substeps):
        a1, b1 = rates(angle, turn, swing)
        turn2, swing2 = turn + h / 2 * a1, swing + h / 2 * b1
        a2, b2 = rates(angle + h / 2 * swing, turn2, swing2)
        turn3, swing3 = turn + h / 2 * a2, swing + h / 2 * b2
        a3, b3 = rates(angle + h / 2 * swing2, turn3, swing3)
        turn4, swing4 = turn + h * a3, swing + h * b3
        a4, b4 = rates(angle + h * swing3, turn4, swing4)
        phi = phi + h / 6 * (turn + 2 * turn2 + 2 * turn3 + turn4)
        angle = angle + h / 6 * (swing + 2 * swing2 + 2 * swing3 + swing4)
        turn = turn + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        swing = swing + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
    turn, swing = (speed.clamp(-FASTEST, FASTEST) for speed in (turn, swing))
    return torch.stack([wrap_angle(phi), wrap_angle(angle), turn, swing], -1)


assert math.isclose(PERIOD / STEP, 25)
