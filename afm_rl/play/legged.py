"""A legged robot of position servos and its policy, from a folder: none needs code of its own."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch

from afm_rl.dynamics.mujoco_model import read_model
from afm_rl.errors import ConfigurationError, check_number, refusing
from afm_rl.planning import policy_from_onnx
from afm_rl.regimes import servo_faults

KNOWN = Path(__file__).parent  # descriptions of robots that others publish
TILTED, LOW, SHAKEN = 0.5, 0.5, 0.02  # cosine; share of the first height; rad
KEYS = {"keyframe", "frame", "period", "action_scale", "command", "speed", "observation", "failing"}


class ServoEnv(gymnasium.Env):
    """A free body with position servos; the observation is the state, the reward minus an error.

    The error is that of the speed (m/s), ahead and sideways. An episode ends when the robot has
    fallen: it lies, or is tilted by more than 60 degrees.

    Args:
        model: of MuJoCo.
        about: what NAME.json says.
    """

    def __init__(self, model: mujoco.MjModel, about: dict[str, Any]) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.key = model.key(about["keyframe"])
        self.frame_skip = round(about["period"] / model.opt.timestep)
        self.dt = self.frame_skip * model.opt.timestep
        self.speed, self.wanted = about["speed"], np.array(about["command"][:2])
        low, high = model.actuator_ctrlrange.T
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        size = model.nq + model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def state_vector(self) -> np.ndarray:
        """Return positions and velocities."""
        return np.concatenate([self.data.qpos, self.data.qvel])

    def set_state(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Go on from there."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = positions, velocities
        mujoco.mj_forward(self.model, self.data)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin in the keyframe, the joints a little off."""
        super().reset(seed=seed)
        positions = self.key.qpos.copy()
        positions[7:] += self.np_random.uniform(-SHAKEN, SHAKEN, len(positions) - 7)
        self.set_state(positions, np.zeros(self.model.nv))
        return self.state_vector(), {}

    def step(self, action: np.ndarray):
        """Send the servos their commands for a period."""
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        state = self.state_vector()
        mujoco.mj_forward(self.model, self.data)
        error = np.linalg.norm(self.data.sensor(self.speed).data[:2] - self.wanted)
        upright = self.data.xmat[1, 8]  # of the free body's own axis
        fallen = upright < TILTED or self.data.qpos[2] < LOW * self.key.qpos[2]
        return state, -float(error), bool(fallen), False, {}


class LeggedRobot:
    """What the files of a folder say of a robot and its policy.

    Args:
        folder: has NAME.xml, NAME_policy.onnx and, unless it is go1 or g1, NAME.json.
        name: of the robot.

    Raises:
        ConfigurationError: if a file is missing, or they do not fit each other.
        ArtefactError: if the policy is damaged, or no policy.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.name, self.about = name, _read(folder, name)
        self.mjcf, _ = read_model(folder / f"{name}.xml")
        if not all(map(self._drives_one_joint, range(self.mjcf.nactuator))):
            raise ConfigurationError(
                f"{name}.xml: expected position servos of one input, each on a hinge or slide joint"
            )
        self.mjcf.opt.timestep = self.about["frame"]
        self.policy = policy_from_onnx(folder / f"{name}_policy.onnx")
        self.low, self.high = torch.from_numpy(self.mjcf.actuator_ctrlrange.T.copy())
        self.data = mujoco.MjData(self.mjcf)  # in which the policy looks at states
        with refusing(f"{name}.json"):  # such as by MuJoCo, which says the names that it has
            self.twin = self.make()
            driven = self.mjcf.actuator_trnid[:, 0]
            self.joints = [self.mjcf.joint(joint).name for joint in driven]
            self.home = torch.from_numpy(self.twin.key.qpos[self.mjcf.jnt_qposadr[driven]])
            failing = [self.mjcf.actuator(servo).id for servo in self.about["failing"]]
            self.faults = servo_faults(self.mjcf.nu, *failing)
            self.parts = [self._part(entry) for entry in self.about["observation"]]
            size = len(self.seen(self.twin.reset(seed=0)[0], np.zeros(self.mjcf.nu), 0.0))
        if (size, self.mjcf.nu) != (self.policy.observation_size, self.policy.action_size):
            raise ConfigurationError(
                f"{name}: {size} observations and {self.mjcf.nu} servos; its policy has "
                f"{self.policy.observation_size} and {self.policy.action_size}"
            )

    def _drives_one_joint(self, servo: int) -> bool:
        """Return whether an actuator has one input, and drives a hinge or a slide joint."""
        mjcf, joint = self.mjcf, self.mjcf.actuator_trnid[servo, 0]
        single = mjcf.actuator_ctrlnum[servo] == 1
        drives = mjcf.actuator_trntype[servo] == mujoco.mjtTrn.mjTRN_JOINT
        kind = mjcf.jnt_type[joint]  # an integer, which enumerations do not contain
        turns, slides = kind == mujoco.mjtJoint.mjJNT_HINGE, kind == mujoco.mjtJoint.mjJNT_SLIDE
        return bool(single and drives and (turns or slides))

    def make(self) -> ServoEnv:
        """Return a new environment."""
        return ServoEnv(self.mjcf, self.about)

    def seen(self, state: np.ndarray, action: np.ndarray, seconds: float) -> np.ndarray:
        """Return what the policy observes in a state, after its last action, at a time (s)."""
        self.data.qpos[:], self.data.qvel[:] = np.split(state, [self.mjcf.nq])
        mujoco.mj_forward(self.mjcf, self.data)
        return np.concatenate([part(action, seconds) for part in self.parts])

    def _part(self, entry: Any) -> Any:
        """Return the function of last action and time that an entry of the observation names."""
        named: dict[str, Any] = {entry: None} if isinstance(entry, str) else entry
        data = self.data
        name, value = next(iter(named.items()))
        if name == "sensor":
            return lambda action, seconds: data.sensor(value).data.copy()
        if name == "gravity":
            return lambda action, seconds: -data.site(value).xmat.reshape(3, 3)[2]
        if name in ("positions", "velocities"):
            joints = range(1, self.mjcf.njnt) if value == "all" else value
            chosen = [self.mjcf.joint(joint) for joint in joints]
            if name == "velocities":
                places = [joint.dofadr[0] for joint in chosen]
                return lambda action, seconds: data.qvel[places]
            places = [joint.qposadr[0] for joint in chosen]
            return lambda action, seconds: data.qpos[places] - self.twin.key.qpos[places]
        if name == "action":
            return lambda action, seconds: action
        if name == "command":
            return lambda action, seconds: np.array(self.about["command"])
        if name == "phases":
            return partial(_phases, np.array(value), 2 * np.pi * named["rate"])
        raise ConfigurationError(
            f"{self.name}.json: observation: {entry!r}: expected sensor, gravity, positions, "
            "velocities, action, command or phases"
        )


class Gait:
    """The policy of a robot in so many episodes side by side, from their start.

    Args:
        robot: whose policy.
        count: of episodes, N.
    """

    def __init__(self, robot: LeggedRobot, count: int = 1) -> None:
        self.robot, self.steps = robot, 0
        self.last = np.zeros((count, robot.mjcf.nu))

    def __call__(self, states: np.ndarray, infos: dict[str, Any] | None = None) -> np.ndarray:
        """Return the commands of all servos ``(*B, A)``, at the time at which they will act."""
        robot = self.robot
        late = np.zeros(len(self.last)) + (infos or {}).get("afm", {}).get("delay", 0)
        seconds = (self.steps + late) * robot.twin.dt
        rows = zip(states.reshape(len(self.last), -1), self.last, seconds, strict=True)
        seen = torch.tensor(np.array([robot.seen(*row) for row in rows]), dtype=torch.float32)
        self.last, self.steps = robot.policy(seen).double().numpy(), self.steps + 1
        wanted = robot.about["action_scale"] * self.last + robot.home.numpy()
        commands = np.clip(wanted, robot.low.numpy(), robot.high.numpy())
        return commands.reshape(*states.shape[:-1], -1)


def _read(folder: Path, name: str) -> dict[str, Any]:
    """Return what NAME.json says, that of the folder or ours."""
    files = [home / f"{name}.json" for home in (folder, KNOWN)]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise ConfigurationError(f"{files[0]}: no such file; docs/howto/play.md describes it")
    with refusing(f"{file}: expected an object of JSON"):
        about = json.loads(file.read_text())
        missing = KEYS - about.keys()
    if missing:
        raise ConfigurationError(f"{file}: {', '.join(sorted(missing))}: missing")
    frames = about["period"] / check_number(f"{file}: frame", about["frame"], low=0, open_low=True)
    check_number(f"{file}: period per frame", frames, low=1)
    return about


def _phases(starts: np.ndarray, rate: float, action: np.ndarray, seconds: float) -> np.ndarray:
    angles = starts + rate * seconds
    return np.concatenate([np.cos(angles), np.sin(angles)])
