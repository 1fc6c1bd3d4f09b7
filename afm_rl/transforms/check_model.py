"""A model is compared with an environment, before anything is corrected."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from afm_rl.dynamics import DynamicsModel, KnownDynamics, MuJoCoDynamics
from afm_rl.dynamics.action_map import ActionMap
from afm_rl.dynamics.linear_residual import nominal_of
from afm_rl.dynamics.predictions import check_predictions
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms.actions import bounds_of
from afm_rl.transforms.gymnasium import ActionFlowWrapper, Model, State, as_numbers
from afm_rl.transforms.simulation import SIMULATOR_STATE, Simulation, SimulatorState, layers_of

if TYPE_CHECKING:
    from afm_rl.diagnosis.model_check import ModelCheck


def check_model(
    env: gymnasium.Env | EnvBase,
    model: Model = "mujoco",
    policy: Callable[[Any], Any] | None = None,
    state: State | None = None,
    steps: int = 300,
    seed: int = 0,
    action_map: ActionMap | None = None,
) -> ModelCheck:
    """Let a healthy robot act for some steps: what share of its motion does a model predict?

    The first thing to do with a model: a correction takes what is wrong with it for faults of the
    actuators. Where a usual mistake explains what it does not predict, that is named: a gain, sign
    or unit of the actions, the time of a step, actions that are late, an environment that scales
    its actions, degrees, angles that jump, normalised observations, forces.

    Args:
        env: a gymnasium or TorchRL environment; it is reset, and left where it comes to.
        model: as in :class:`~afm_rl.ActionFlowWrapper`: ``"mujoco"``, the environment's own, a step
            function in torch, or a :class:`~afm_rl.dynamics.DynamicsModel`.
        policy: returns the action for an observation; in TorchRL, a policy of a rollout. None:
            random actions, which show the most, to a robot that may do anything.
        state: as in :class:`~afm_rl.ActionFlowWrapper`; in TorchRL, its key.
        steps: that are compared; where a wrapper normalises observations, as many come before.
        seed: of environment and random actions.
        action_map: as in :class:`~afm_rl.ActionFlowWrapper`, of ``"mujoco"``.

    Returns:
        Is the model ``right``, which ``share`` it predicts (0 to 1), and the ``cause`` if not; if
        that is a map of the actions, its ``action_map``.

    Raises:
        ConfigurationError: for a model that does not fit, or a robot that rests.

    >>> def step(state, action):  # of Pendulum-v1: cosine, sine and speed of an angle
    ...     sine, speed = state[..., 1:2], state[..., 2:]
    ...     speed = (speed + 0.05 * (15 * sine - 3 * action)).clamp(-8, 8)
    ...     angle = torch.atan2(sine, state[..., :1]) + 0.05 * speed
    ...     return torch.cat([angle.cos(), angle.sin(), speed], -1)
    >>> found = check_model(gymnasium.make("Pendulum-v1"), step)
    >>> found.right, found.cause
    (False, 'acts on -1 times the action (a sign)')
    """
    check_count("check_model: steps", steps)
    roll_out = _in_torchrl if isinstance(env, EnvBase) else _in_gymnasium
    if isinstance(model, str) and model == "mujoco" and action_map is None:
        action_map = (1.0, 0.0)  # spaces that differ are what is looked for
    known, (states, actions, after) = roll_out(env, model, policy, state, steps, seed, action_map)
    from afm_rl.diagnosis.model_check import check_transitions

    return check_transitions(known, states, actions, after)


def _in_gymnasium(
    env: gymnasium.Env,
    model: Model,
    policy: Any,
    state: State | None,
    steps: int,
    seed: int,
    action_map: ActionMap | None,
) -> tuple[DynamicsModel, list[Tensor]]:
    """Return the model, and states, actions and next states as a wrapper has them."""
    wrapper = ActionFlowWrapper(
        env, model, state, action_map=action_map, enabled=False, delay_compensation=False
    )
    if wrapper.collection is not None:
        raise ConfigurationError("check_model: model='learn': there is no model yet to check")
    space: Any = env.action_space
    space.seed(seed)
    # What normalises observations by what it has seen must keep still to be seen through.
    layers = [one for one in layers_of(env) if getattr(one, "update_running_mean", False)]
    rows, (observation, _) = [], wrapper.reset(seed=seed)
    try:
        for step in range(-steps if layers else 0, steps):
            for layer in layers:
                layer.update_running_mean = step < 0
            wanted = space.sample() if policy is None else policy(observation)
            planned = as_numbers("action", wanted, space.shape).numpy()
            action = np.clip(planned, space.low, space.high).astype(space.dtype)
            (before,) = wrapper._states_in([observation])
            observation, _, terminated, truncated, _ = env.step(action)
            (after,) = wrapper._states_in([observation])
            rows.append((before, torch.from_numpy(action), after))
            if terminated or truncated:
                observation, _ = env.reset()
    finally:
        for layer in layers:
            layer.update_running_mean = True
    columns = zip(*rows[-steps:], strict=True)
    return wrapper._loop.model, [torch.stack(column) for column in columns]


def _in_torchrl(
    env: EnvBase,
    model: Model,
    policy: Any,
    state: Any,
    steps: int,
    seed: int,
    action_map: ActionMap | None,
) -> tuple[DynamicsModel, list[Tensor]]:
    """Return the same of a rollout; ``state`` is a key."""
    key = "observation" if state is None else state
    if isinstance(model, str) and model == "mujoco":
        bounds = bounds_of(env.full_action_spec[env.action_key])
        model = Simulation(env).dynamics(*bounds, action_map)
    if isinstance(nominal_of(model), MuJoCoDynamics) and state is None:
        key, env = SIMULATOR_STATE, TransformedEnv(env, SimulatorState(), auto_unwrap=False)
    if not callable(model):
        raise ConfigurationError(
            f"check_model: model={model!r}: expected 'mujoco', a step function or a DynamicsModel"
        )
    env.set_seed(seed)
    data = env.rollout(steps, policy, break_when_any_done=False)
    if data.get(key, None) is None:
        raise ConfigurationError(
            f"check_model: state={key!r}: the environment has no such entry, but "
            f"{list(env.full_observation_spec.keys(True, True))}"
        )
    rows = [data.get(name).flatten(0, -2) for name in (key, env.action_key, ("next", key))]
    if not isinstance(model, DynamicsModel):
        model = KnownDynamics(model, Manifold(rows[0].shape[-1]), rows[1].shape[-1])
    check_predictions("check_model: model", model, *rows[:2])  # as a wrapper does
    return model, rows
