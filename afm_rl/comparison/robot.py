"""Any environment as a robot of gymnasium that can be made many times."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import SyncVectorEnv
from torchrl.envs import DMControlWrapper, EnvBase, step_mdp

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.dynamics.linear_residual import nominal_of
from afm_rl.errors import ConfigurationError, refusing
from afm_rl.transforms.actions import bounds_of
from afm_rl.transforms.simulation import Simulation, states_of

LONGEST = 1000  # steps of an episode where the environment does not say
COPY = (
    "give a function that makes one, such as lambda: MyEnv(), or the id of a registered environment"
)


@dataclass
class Robot:
    """An environment of gymnasium, many times, and what a correction must know of it.

    Attributes:
        name: in titles.
        make: makes a new environment.
        settings: arguments of :class:`~afm_rl.ActionFlowVectorWrapper`; ``state`` and ``observe``
            as in :class:`~afm_rl.ActionFlowWrapper`.
        home: pose of position servos, as :class:`~afm_rl.FaultWrapper` takes it.
    """

    name: str
    make: Callable[[], gymnasium.Env]
    settings: dict[str, Any] = field(default_factory=dict)
    home: Any = None

    @cached_property
    def first(self) -> gymnasium.Env:
        """One environment, to look at."""
        return self.make()

    @property
    def limit(self) -> int:
        """Steps of an episode, at most."""
        return getattr(self.first.spec, "max_episode_steps", None) or LONGEST

    @property
    def dt(self) -> float | None:
        """Seconds of a step, if the environment says it."""
        return getattr(self.first.unwrapped, "dt", None)

    @property
    def sizes(self) -> tuple[int, int]:
        """How many numbers an observation and an action have."""
        return tuple(  # type: ignore[return-value]
            math.prod(space.shape or ())
            for space in (self.first.observation_space, self.first.action_space)
        )

    def vector(self, count: int) -> SyncVectorEnv:
        """Return ``count`` environments."""
        return SyncVectorEnv([self.make] * count)

    @property
    def vector_settings(self) -> dict[str, Any]:
        """The settings of a correction around :meth:`vector`."""
        state = self.settings.get("state")
        if state is None:
            return self.settings
        return self.settings | {"state": partial(_each, state)}


def _each(state: Callable[[Any, Any], Any], envs: Any, observations: Any) -> np.ndarray:
    """Return the states of all environments of a vector, ``(N, S)``."""
    rows = zip(envs.unwrapped.envs, observations, strict=True)
    return np.stack([state(env, observation) for env, observation in rows])


def read_robot(env: Any, **settings: Any) -> Robot:
    """Return the robot in an environment of any kind.

    Args:
        env: id of gymnasium; an environment of gymnasium, TorchRL or dm_control; or a function that
            makes one.
        settings: arguments of :class:`~afm_rl.ActionFlowWrapper`.

    Raises:
        ConfigurationError: for an unknown id, anything else, or what cannot be made again.
    """
    if isinstance(env, str):
        name, make = env, _registered(env)
    elif _is_environment(env):
        inner = getattr(env, "unwrapped", env)
        name = env.spec.id if getattr(env, "spec", None) else type(inner).__name__
        make = _copying(env)
    elif callable(env):
        name, make = getattr(env, "__name__", type(env).__name__), env
    else:
        raise ConfigurationError(
            f"compare: env={env!r:.80}: expected the id of a gymnasium environment, an environment "
            "of gymnasium, TorchRL or dm_control, or a function that makes one"
        )
    with refusing(f"compare: env={name}: cannot be made; {COPY}"):
        first = make()
    if not _is_environment(first):
        raise ConfigurationError(
            f"compare: env={name}: made a {type(first).__name__}; expected an environment of "
            "gymnasium, TorchRL or dm_control"
        )
    if isinstance(first, gymnasium.Env):
        robot = Robot(name, make, settings)
    else:
        found = EnvRobot(first)
        settings = found.settings(settings)
        name = type(found.env).__name__ if name == "<lambda>" else name
        robot = Robot(name, lambda: EnvRobot(make()), settings)
    actions, seen = robot.first.action_space, robot.first.observation_space
    if not (isinstance(actions, Box) and len(actions.shape) == 1 and isinstance(seen, Box)):
        raise ConfigurationError(
            f"compare: env={robot.name}: observation_space={seen}, action_space={actions}: "
            "expected vectors of real numbers; flatten them with gymnasium's wrappers"
        )
    return robot


def _is_environment(env: Any) -> bool:
    return isinstance(env, gymnasium.Env | EnvBase) or _of_dm_control(env)


def _of_dm_control(env: Any) -> bool:
    return hasattr(env, "physics") and hasattr(env, "action_spec") and hasattr(env, "task")


def _registered(name: str) -> Callable[[], gymnasium.Env]:
    """Return what makes the environment of an id."""
    try:
        gymnasium.spec(name)
    except (gymnasium.error.Error, ImportError) as error:
        near = get_close_matches(name, gymnasium.registry, 3, cutoff=0.5)
        advice = f"; did you mean {' or '.join(near)}?" if near else ""
        raise ConfigurationError(
            f"compare: env={name!r}: expected the id of a gymnasium environment{advice}"
        ) from error
    return partial(gymnasium.make, name)


def _copying(env: Any) -> Callable[[], Any]:
    """Return what makes an environment again, by its specification or as a copy."""
    if getattr(env, "spec", None) is not None:
        return partial(gymnasium.make, env.spec)
    with refusing(f"compare: env={type(env).__name__}: cannot be copied; {COPY}"):
        deepcopy(env)
    return partial(deepcopy, env)


class EnvRobot(gymnasium.Env):
    """An environment of TorchRL or dm_control as one of gymnasium: a vector is observed.

    Args:
        env: without a batch, with one vector of bounded actions.
    """

    def __init__(self, env: Any) -> None:
        self.env: EnvBase = DMControlWrapper(env) if _of_dm_control(env) else env
        if self.env.batch_size:
            raise ConfigurationError(
                f"compare: env: a batch of {tuple(self.env.batch_size)} environments; give one"
            )
        specs = self.env.full_observation_spec.items(True, True)
        self.parts = {
            key: (spec.shape, spec.dtype) for key, spec in specs if spec.dtype.is_floating_point
        }
        """Shape and type of each observation, by its key."""
        low, high = (end.numpy() for end in bounds_of(self.env.action_spec))
        self.action_space = Box(low, high, dtype=low.dtype)
        size = sum(math.prod(shape) for shape, _ in self.parts.values())
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float64)
        inner: Any = getattr(self.env, "_env", None)  # of dm_control
        self.dt = inner.control_timestep() if hasattr(inner, "control_timestep") else None

    def settings(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the settings of a correction: model, state and observation of a simulation."""
        action_map, model = given.get("action_map"), given.get("model")
        if isinstance(model, str) and model == "mujoco":
            found = self.simulation.dynamics(*bounds_of(self.env.action_spec), action_map)
            given = {**given, "model": found, "action_map": None}
        nominal = nominal_of(given.get("model"))
        if isinstance(nominal, MuJoCoDynamics) and given.get("state") is None:
            given = {**given, "state": partial(_simulated, nominal)}
            if given.get("observe") is None and {*self.simulation.seen} == {*self.parts}:
                given["observe"] = partial(_observed, self.simulation, [*self.parts])
        return given

    @cached_property
    def simulation(self) -> Simulation:
        """The simulation inside of it."""
        return Simulation(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self.step_data = self.env.reset()
        return self._seen(self.step_data), {}

    def step(self, action: np.ndarray):
        """Make a step."""
        data = self.step_data.set(self.env.action_key, torch.from_numpy(np.array(action)))
        data = self.env.step(data)
        after = data["next"]
        self.step_data = step_mdp(data)
        ends = (bool(after.get(name, torch.zeros(1)).any()) for name in ("terminated", "truncated"))
        return self._seen(after), float(after[self.env.reward_key]), *ends, {}

    def _seen(self, data: Any) -> np.ndarray:
        parts = [data[key].double().flatten() for key in self.parts]
        return torch.cat(parts).numpy()


def _simulated(model: MuJoCoDynamics, env: EnvRobot, observation: Any) -> np.ndarray:
    """Return the state of the simulation in an environment."""
    return states_of([env.simulation.host], model)[0]


def _observed(simulation: Simulation, keys: list[Any], states: np.ndarray) -> np.ndarray:
    seen = simulation.observe(states)
    return np.concatenate([seen[key].reshape(len(states), -1) for key in keys], -1)
