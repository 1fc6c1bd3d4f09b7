"""The robots of the page, each with a policy or a planner."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins, MuJoCoDynamics, Quadrotor
from afm_rl.dynamics.mujoco_model import actuator_names
from afm_rl.envs.task.rewards import pendulum_step
from afm_rl.errors import ConfigurationError, check_choice, refusing
from afm_rl.planning import (
    MPC,
    MPPI,
    GoalDistance,
    PlanningEnv,
    TrackingCost,
    load_policy,
    policy_from_onnx,
)
from afm_rl.planning.riccati import stationary_value
from afm_rl.play.legged import Gait, LeggedRobot
from afm_rl.regimes.presets import Fault

Acting = Callable[..., np.ndarray]  # of an observation, and of infos if a clock counts


@dataclass(frozen=True)
class PlayedRobot:
    """What the page needs to know of a robot.

    Attributes:
        name: what it is called.
        make: makes an environment without a time limit.
        policy: makes a policy for an episode; each has its own, as planners remember.
        model: keyword arguments of :class:`~afm_rl.ActionFlowWrapper`.
        push: pushes a robot, given its innermost environment and a direction of -1 or 1.
        dt: seconds a step.
        names: of the actuators.
        score: what is counted of an episode: the name of an info, or ``reward``.
        corrector: makes the correction; None: an ActionFlow in units of the box.
        task: of gymnasium, without its version, if it has a stored policy.
        faults: what can happen to its actuators, by name; None: the presets.
        home: pose of position servos, see :class:`~afm_rl.regimes.Actuators`.
    """

    name: str
    make: Callable[[], gymnasium.Env]
    policy: Callable[[], Acting]
    model: dict[str, Any]
    push: Callable[[Any, float], None]
    dt: float
    names: list[str]
    score: str = "reward"
    corrector: Callable[[], Any] = lambda: None
    task: str | None = None
    faults: dict[str, Fault] | None = None
    home: torch.Tensor | None = None


def make_robot(name: str | None = None, file: str | Path | None = None) -> PlayedRobot:
    """Return a robot of :data:`ROBOTS`, or the one that the policy in a file was trained for.

    Args:
        name: of the robot, or a folder and the name of a legged robot in it, such as
            ``FOLDER/go1``; ``half_cheetah`` without name and file.
        file: what :func:`~afm_rl.planning.save_policy` wrote, with a task of gymnasium as ``id``
            and, if it has any, numbers as its ``settings``; or an ONNX file, for the named robot.

    Raises:
        ConfigurationError: for an unknown name, or a file that does not fit it.
        ArtefactError: if the file is damaged, or holds something else.
    """
    legged = Path(name or "")
    if name not in ROBOTS and (len(legged.parts) > 1 or Path(f"{name}.xml").is_file()):
        if file is not None:
            raise ConfigurationError(f"--policy={file}: {name} has its own policy; omit --policy")
        return _legged(LeggedRobot(legged.parent, legged.name))
    if file is None:
        return ROBOTS[check_choice("--robot", name or "half_cheetah", ROBOTS)]()
    graph = Path(file).suffix == ".onnx"
    if name is None and graph:
        raise ConfigurationError(
            f"--policy={file}: an ONNX file does not state its task; name the robot, too, "
            "such as --robot half_cheetah"
        )
    if name is None:
        return _stored(Path(file))
    robot_of_name = ROBOTS[check_choice("--robot", name, ROBOTS)]()
    if robot_of_name.task is None:
        raise ConfigurationError(f"--policy={file}: {name} has a controller; omit --policy")
    if graph:
        policy = policy_from_onnx(file)
        _check_fits(file, robot_of_name, (policy.observation_size, policy.action_size))
        return replace(robot_of_name, policy=lambda: _acting(policy))
    robot = _stored(Path(file))
    if robot_of_name.task != robot.task:
        raise ConfigurationError(
            f"--robot={name}: the policy in {file} acts in {robot.name}; omit --robot"
        )
    return robot


def _stored(file: Path, name: str | None = None) -> PlayedRobot:
    """Return the robot of gymnasium that a stored policy acts in."""
    policy, about = load_policy(file)
    task, settings = about.get("id"), about.get("settings", {})
    if not isinstance(task, str) or task not in gymnasium.registry:
        raise ConfigurationError(f"{file}: id={task!r:.80}: expected a task of gymnasium")
    if not isinstance(settings, dict) or not all(map(_numeric, settings.values())):
        raise ConfigurationError(f"{file}: settings={settings!r:.80}: expected numbers, by name")
    with refusing(f"{file}: {task} cannot be played"):
        robot = _gymnasium(name or task, task, lambda: _acting(policy), settings)
        _check_fits(file, robot, (policy.observation_size, len(policy.low)))
    return robot


def _acting(policy: Callable[[torch.Tensor], torch.Tensor]) -> Acting:
    return lambda seen, infos=None: policy(torch.as_tensor(seen, dtype=torch.float32)).numpy()


def _check_fits(file: str | Path, robot: PlayedRobot, sizes: tuple[int, int]) -> None:
    """Check that a policy has as many observations and actions as the robot."""
    env = robot.make()
    shapes = env.observation_space.shape, env.action_space.shape
    if shapes != ((sizes[0],), (sizes[1],)):
        raise ConfigurationError(
            f"{file}: a policy of {sizes[0]} observations and {sizes[1]} actions; {robot.name} has "
            f"{shapes[0]} and {shapes[1]}"
        )


def _numeric(value: Any) -> bool:
    return all(map(_numeric, value)) if isinstance(value, list) else isinstance(value, int | float)


def _gymnasium(
    name: str, task: str, policy: Callable[[], Acting], settings: dict[str, Any]
) -> PlayedRobot:
    def make() -> gymnasium.Env:
        return gymnasium.make(task, max_episode_steps=-1, **settings)

    inner: Any = make().unwrapped
    kind = gymnasium.spec(task).name
    if hasattr(inner, "model"):
        model: dict[str, Any] = {"model": "mujoco"}
        names = actuator_names(inner.model)
        return PlayedRobot(name, make, policy, model, _push_root, inner.dt, names, task=kind)
    if kind != "Pendulum":
        raise ConfigurationError("it is neither a task of MuJoCo nor the pendulum")
    model = {"model": pendulum_step}
    model["state"] = lambda env, seen: env.unwrapped.state
    model["observe"] = lambda s: np.c_[np.cos(s[:, 0]), np.sin(s[:, 0]), s[:, 1]]
    return PlayedRobot(name, make, policy, model, _push_pendulum, inner.dt, ["joint"], task=kind)


def _push_root(inner: Any, direction: float) -> None:
    """Add 1 m/s, or 1 rad/s, to the first velocity."""
    inner.data.qvel[0] += direction


def _push_pendulum(inner: Any, direction: float) -> None:
    inner.state = np.array(inner.state) + [0.0, 3.0 * direction]


def _cart_pole() -> PlayedRobot:
    """A cart with a pole, by the linear quadratic regulator."""
    env: Any = gymnasium.make("InvertedPendulum-v5")
    upright = torch.zeros(4, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    _, a, b = MuJoCoDynamics(env).linearise(*upright)
    cost = torch.tensor([1.0, 10.0, 0.1, 0.1]).diag(), torch.eye(1)
    gain = stationary_value(a, b, *cost)[1].numpy()
    space = env.action_space

    def act(seen: np.ndarray, infos: Any = None) -> np.ndarray:
        return np.clip(-gain @ seen, space.low, space.high).astype(np.float32)

    return replace(_gymnasium("cart_pole", "InvertedPendulum-v5", lambda: act, {}), task=None)


def _planned(planner: Any, parts: dict[str, tuple[int, ...]]) -> Acting:
    """Return a policy that plans; what it sees are ``parts``, by key and shape, in a row."""
    memory = planner.make_tensordict_primer()(TensorDict({}))
    sizes = [math.prod(shape) for shape in parts.values()]

    def act(seen: np.ndarray, infos: Any = None) -> np.ndarray:
        nonlocal memory
        values = torch.as_tensor(seen).float().split(sizes)
        for (key, shape), value in zip(parts.items(), values, strict=True):
            memory[key] = value.reshape(shape)
        planned = planner(memory)
        memory = step_mdp(planned)
        return planned["action"].numpy()

    return act


def _legged(robot: LeggedRobot) -> PlayedRobot:
    return PlayedRobot(
        robot.name,
        robot.make,
        lambda: Gait(robot),
        {"model": "mujoco"},
        _push_root,
        robot.twin.dt,
        robot.joints,
        faults=robot.faults,
        home=robot.home,
    )


def _first(size: int) -> dict[str, Any]:
    """Return how to find the state where it is the first numbers of an observation, and back."""
    rest = np.zeros(0)

    def state(env: Any, seen: np.ndarray) -> np.ndarray:
        nonlocal rest
        rest = seen[size:]
        return seen[:size]

    def observe(states: np.ndarray) -> np.ndarray:
        return np.concatenate([states, np.tile(rest, (len(states), 1))], 1)

    return {"state": state, "observe": observe}


def _ugv() -> PlayedRobot:
    """The ground robot on its track, by MPPI."""
    low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    dynamics = Dubins()

    def policy() -> Acting:
        planner = MPPI(PlanningEnv(dynamics, GoalDistance(), low, high), candidates=512)
        return _planned(planner, {"observation": (3,), "goal": (2,)})

    def make() -> gymnasium.Env:
        return gymnasium.make("afm_rl/UGVTrack-v0", max_episode_steps=-1)

    def push(inner: Any, direction: float) -> None:
        inner._data["pose"] += torch.tensor([0.0, 0.0, 0.5 * direction])

    model = {"model": dynamics, **_first(3)}
    return PlayedRobot("ugv", make, policy, model, push, 0.2, ["speed", "turn"], score="reached")


def _quadrotor() -> PlayedRobot:
    """A small quadrotor that flies in a circle, by model predictive control."""
    name, ahead = "afm_rl/CrazyflieTrack-v0", 20
    dynamics, level = Quadrotor(dt=0.05), [0.0] * 9 + [1.0] + [0.0] * 3
    cost = TrackingCost([1.0] * 13, [1.0] * 4, coordinates=range(6), rest=level)
    box: Any = gymnasium.make(name).action_space
    unit = torch.tensor([0.575, 3e-4, 3e-4, 1e-4])  # what flights use of the box

    def make() -> gymnasium.Env:
        long: dict[str, Any] = {"max_episode_steps": -1, "duration": 3600.0}  # s
        env = gymnasium.make(name, **long, horizon=ahead, limit=3.0)  # m: then it is lost
        shape = (13 + 6 * (ahead + 1),)
        space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)

        def seen(observation: np.ndarray) -> np.ndarray:  # and the circle ahead
            ahead_of: Any = env.unwrapped
            return np.append(observation[:13], ahead_of._data["reference"].numpy().ravel())

        return TransformObservation(env, seen, space)

    def policy() -> Acting:
        low, high = torch.from_numpy(box.low), torch.from_numpy(box.high)
        planner = MPC(PlanningEnv(dynamics, cost, low, high), horizon=ahead, bounded=[0])
        return _planned(planner, {"observation": (13,), "reference": (ahead + 1, 6)})

    def push(inner: Any, direction: float) -> None:
        inner._data["pose"][3] += 0.5 * direction

    model = {"model": dynamics, **_first(13)}
    names = ["thrust", "roll", "pitch", "yaw"]
    corrector = partial(ActionFlow, -unit, unit)
    return PlayedRobot("quadrotor", make, policy, model, push, 0.05, names, corrector=corrector)


def _usual(name: str, file: str) -> Callable[[], PlayedRobot]:
    """Return what makes a robot of a policy that a wheel has, or the repository's examples."""
    folder = Path(__file__).parent / "policies"
    if not folder.is_dir():
        folder = Path(__file__).parents[2] / "examples" / "policies" / "zoo"
    return lambda: _stored(folder / f"{file}.safetensors", name)


ROBOTS: dict[str, Callable[[], PlayedRobot]] = {
    "half_cheetah": _usual("half_cheetah", "half_cheetah_tqc"),
    "hopper": _usual("hopper", "hopper_trpo"),
    "walker2d": _usual("walker2d", "walker2d_tqc"),
    "ant": _usual("ant", "ant_trpo"),
    "swimmer": _usual("swimmer", "swimmer_trpo"),
    "pendulum": _usual("pendulum", "pendulum_sac"),
    "cart_pole": _cart_pole,
    "ugv": _ugv,
    "quadrotor": _quadrotor,
}
