"""The MuJoCo simulation inside an environment: its state, and what is observed in others."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorObservationWrapper, VectorWrapper
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    DTypeCastTransform,
    EnvBase,
    FrameSkipTransform,
    GymLikeEnv,
    ParallelEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)

from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.action_map import ActionMap
from afm_rl.dynamics.linear_residual import nominal_of
from afm_rl.dynamics.mujoco_model import host_of
from afm_rl.errors import ConfigurationError
from afm_rl.transforms.stateful import StatefulTransform

SIMULATOR_STATE = "simulator_state"
"""The key of a simulation's whole state: positions, velocities and activations."""
CHANGED = gymnasium.ObservationWrapper, VectorObservationWrapper


class Simulation:
    """The MuJoCo simulation inside an environment, which is left as it was.

    Observations in other states come from the environment's own function: its simulation is put
    into these states, and back. Of environments that run in other processes, one is made here.

    Args:
        env: of gymnasium, dm_control or TorchRL, or a vector or batch of such.

    Raises:
        ConfigurationError: if there is no such simulation.

    >>> simulation = Simulation(gymnasium.make("Reacher-v5"))
    >>> simulation.observe(np.zeros((3, 8)))["observation"].shape
    (3, 10)
    """

    def __init__(self, env: Any) -> None:
        self.layers = layers_of(env)
        self.inner = self.layers[-1]
        self.host = getattr(self.inner, "physics", host_of(self.inner))  # dm_control's
        if not all(hasattr(self.host, name) for name in ("data", "model")):
            raise ConfigurationError(
                f"{' '.join(str(env).split())} has no MuJoCo model, from which the state is read; "
                "say what it is by state=lambda env, observation: ..."
            )
        self._kept: tuple[Any, Any] = None, None

    @property
    def state(self) -> Tensor:
        """Positions, velocities and activations at present, ``(S,)``.

        Raises:
            ConfigurationError: if this is not the environment's own simulation.
        """
        if any(isinstance(layer, ParallelEnv | SerialEnv | VectorEnv) for layer in self.layers):
            raise ConfigurationError(
                f"{SIMULATOR_STATE!r}: the simulations run elsewhere; append SimulatorState() to "
                "the environment that each worker of ParallelEnv makes, or put ActionFlowTransform "
                "around that one"
            )
        return torch.from_numpy(states_of([self.host])[0])

    def state_for(self, model: Any) -> Tensor:
        """Return :attr:`state`; a model of MuJoCo gets the start of its solver there."""
        state = self.state
        self.read(nominal_of(model))
        return state

    def read(self, model: Any, *_: Any) -> np.ndarray:
        """Return the state ``(S,)``, also of a simulation that runs elsewhere; see above."""
        return states_of([self.host], model)[0]

    def dynamics(
        self, low: Tensor, high: Tensor, action_map: ActionMap | None = None
    ) -> DynamicsModel:
        """Return the model of one action, with the frames that are skipped.

        Args:
            low: lowest action, ``(*B, A)``.
            high: highest action.
            action_map: see :class:`~afm_rl.dynamics.MuJoCoDynamics`.

        Raises:
            ConfigurationError: if actions between these are not the simulation's controls, and no
                map is given.
        """
        from afm_rl.dynamics.mujoco import MuJoCoDynamics, read_model

        _, skip = read_model(self.inner)
        skips = [t.frame_skip for t in self._transforms if isinstance(t, FrameSkipTransform)]
        skips += [
            getattr(e, "wrapper_frame_skip", 1) for e in self.layers if isinstance(e, GymLikeEnv)
        ]
        found = MuJoCoDynamics(self.inner, skip * math.prod(skips), action_map=action_map)
        found.check_range(low, high)
        return found

    @cached_property
    def seen(self) -> list[NestedKey]:
        """Keys of the observations, if they are those of :meth:`observe`: nothing changes them."""
        env = self.layers[0]
        if self._look is None or any(isinstance(layer, CHANGED) for layer in self.layers):
            return []
        if isinstance(env, EnvBase):
            specs, lead = env.full_observation_spec.items(True, True), len(env.batch_size)
            shapes = {key: spec.shape[lead:] for key, spec in specs}
        else:
            space = getattr(env, "single_observation_space", env.observation_space)
            shapes = {"observation": space.shape}
        harmless = DTypeCastTransform, StatefulTransform
        changes = [t for t in self._transforms if not isinstance(t, harmless)]
        changed = {key for t in changes for key in (*t.in_keys, *t.out_keys)}
        seen = self.observe(states_of([self.host]))
        found = {key: value.shape[1:] for key, value in seen.items()}
        alike = all(shapes.get(key) == shape for key, shape in found.items())
        return list(found) if alike and changed.isdisjoint(found) else []

    def observe(self, states: np.ndarray) -> dict[Any, np.ndarray]:
        """Return what is observed in states ``(N, S)``, by key, ``(N, ...)`` each.

        One array of gymnasium's is ``"observation"``.
        """
        import mujoco

        model, data = (getattr(part, "ptr", part) for part in (self.host.model, self.host.data))
        look: Any = self._look
        ends, rows, now = [model.nq, model.nq + model.nv], [], self._copy_of(model, data)
        for state in states:
            try:
                data.qpos[:], data.qvel[:], data.act[:] = np.split(state, ends)
                mujoco.mj_forward(model, data)
                mujoco.mj_rnePostConstraint(model, data)  # forces of contacts
                seen = look()
            finally:
                mujoco.mj_copyData(data, model, now)
            seen = seen if isinstance(seen, Mapping) else {"observation": seen}
            rows.append({key: np.array(value, ndmin=1) for key, value in seen.items()})
        return {key: np.stack([row[key] for row in rows]) for key in rows[0]}

    def show(self, tensordict: TensorDictBase, states: Tensor, rows: Tensor) -> None:
        """Replace what was observed by what is in states ``(*B, S)``, in ``rows`` ``(*B)``."""
        for key, value in self.observe(states[rows].cpu().double().numpy()).items():
            shown = tensordict.get(key).clone()
            shown[rows] = torch.from_numpy(value).to(shown)
            tensordict.set(key, shown)

    def _copy_of(self, model: Any, data: Any) -> Any:
        """Return a copy of the simulation's data; its memory is used again, as it is large."""
        import mujoco

        if self._kept[0] is not model:
            self._kept = model, mujoco.MjData(model)
        mujoco.mj_copyData(self._kept[1], model, data)
        return self._kept[1]

    @cached_property
    def _look(self) -> Callable[[], Any] | None:
        """The function that observes the simulation as it is; None if there is none."""
        task: Any = getattr(self.inner, "task", None)
        look = getattr(self.inner, "_get_obs", None)
        if look is None and hasattr(task, "get_observation"):  # dm_control's
            return partial(task.get_observation, self.host)
        return look if look is not None and _takes_nothing(look) else None

    @property
    def _transforms(self) -> list[Transform]:
        chains = [layer.transform for layer in self.layers if isinstance(layer, TransformedEnv)]
        return [t for chain in chains for t in getattr(chain, "transforms", [chain])]


def _takes_nothing(function: Callable[..., Any]) -> bool:
    try:
        inspect.signature(function).bind()
    except TypeError:
        return False
    return True


def states_of(hosts: Sequence[Any], model: Any = None) -> np.ndarray:
    """Return positions, velocities and activations of simulations, ``(N, S)``.

    Args:
        hosts: what has the simulations' ``data``, or environments with such.
        model: of MuJoCo, which gets the start of its solver there; other models get nothing.
    """
    found = [x if hasattr(x, "data") and hasattr(x, "model") else host_of(x) for x in hosts]
    data = [host.data for host in found]
    states = np.stack([np.concatenate([of.qpos, of.qvel, of.act]) for of in data])
    if hasattr(model, "warm_start"):
        model.warm_start(states, np.stack([of.qacc_warmstart for of in data]))
    return states


def check_action_map(place: str, action_map: ActionMap | None, model: Any) -> None:
    """Refuse a map of actions beside a model that has, or would have, its own."""
    if action_map is not None and not (isinstance(model, str) and model == "mujoco"):
        raise ConfigurationError(
            f"{place}.action_map: the model is given, too; expected it with model='mujoco', "
            "give it to MuJoCoDynamics otherwise"
        )


def simulation_in(env: Any) -> Simulation | None:
    """Return the simulation inside an environment, if there is one."""
    try:
        return Simulation(env)
    except ConfigurationError:
        return None


def layers_of(env: Any) -> list[Any]:
    """Return the wrappers of an environment, the outermost first, and itself.

    Of a vector or a batch it is the first one, which is made if they run in other processes.
    """
    found = [env]
    while True:
        layer: Any = found[-1]
        if isinstance(layer, TransformedEnv):
            inner = layer.base_env
        elif isinstance(layer, SerialEnv) and not layer.is_closed:
            inner = layer._envs[0]
        elif isinstance(layer, ParallelEnv | SerialEnv):
            inner = layer.create_env_fn[0](**layer.create_env_kwargs[0])
        elif isinstance(layer, EnvBase):
            inner = vars(layer).get("_env")
        elif isinstance(layer, VectorWrapper):  # it passes on the attributes of what it wraps
            inner = layer.env
        elif getattr(layer, "envs", None):  # of a vector in this process
            inner = layer.envs[0]
        elif getattr(layer, "env_fns", None):
            inner = layer.env_fns[0]()
        else:
            inner = getattr(layer, "env", None)
        if inner is None:
            return found
        found.append(inner)


class SimulatorState(Transform):
    """Writes the state of the MuJoCo simulation inside an environment to ``"simulator_state"``.

    Positions, velocities and activations, ``(S,)``: for an
    :class:`~afm_rl.transforms.ActionFlowTransform` around workers, whose simulations it cannot
    read, or for models that learn.

    Raises:
        ConfigurationError: if there is no simulation, or it runs elsewhere.

    >>> from torchrl.envs import GymEnv
    >>> env = TransformedEnv(GymEnv("HalfCheetah-v5"), SimulatorState())
    >>> env.reset()["simulator_state"].shape
    torch.Size([18])
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=[SIMULATOR_STATE])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        state = Simulation(self.parent).state
        return next_tensordict.set(SIMULATOR_STATE, state.to(next_tensordict.device or "cpu"))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        state = Simulation(self.parent).state
        spec = Unbounded(state.shape, dtype=state.dtype, device=observation_spec.device)
        observation_spec[SIMULATOR_STATE] = spec
        return observation_spec
