"""Tasks of gymnasium."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.envs.task.hosts import environment_task
from afm_rl.envs.task.pendulum import pendulum_observation, pendulum_step
from afm_rl.envs.task.quiet import quiet
from afm_rl.envs.task.rewards import GYMNASIUM
from afm_rl.envs.task.simulated import EXACT, Limits, known_of, simulated, state_of
from afm_rl.envs.task.task import NOWHERE, Reward, Task, trust
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold


def gymnasium_task(
    id: str,  # noqa: A002 - what gymnasium calls it
    reward: Reward | None = None,
    steps: int | None = None,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task of gymnasium.

    Of MuJoCo tasks and of Pendulum-v1 the state is whole and the physics are known; of others the
    state is the observation, and a model has to be learned, see
    :func:`~afm_rl.envs.environment_task`.

    Args:
        id: name in gymnasium's registry.
        reward: in torch, see :class:`~afm_rl.envs.Task`; the task's own if None, where it is known.
        steps: length of an episode; the registered one if None.
        action_low: lowest action; the task's if None.
        action_high: highest action.

    Raises:
        ConfigurationError: if there is no such task, or nothing is known of it.

    >>> gymnasium_task("Pendulum-v1").state_names
    ['angle', 'speed']
    """
    import gymnasium

    try:
        with quiet():
            env = gymnasium.make(id)
    except (gymnasium.error.Error, ImportError, AttributeError) as error:
        raise ConfigurationError(f"robot.id={id!r}: {error}") from error
    limits = action_low, action_high
    steps = steps or (env.spec.max_episode_steps if env.spec else None) or 1000
    inner: Any = env.unwrapped
    if not hasattr(inner, "model") and id not in GYMNASIUM:
        from torchrl.envs import GymEnv

        make = partial(GymEnv, id)
        return environment_task(make, reward, steps, 0.05, "observation", *limits, id)
    known = known_of("robot.id", id, GYMNASIUM, reward, getattr(inner, "model", None))
    if id == "Pendulum-v1":

        def begin(seed: int) -> tuple[Tensor, Tensor]:
            env.reset(seed=seed)
            return torch.tensor(inner.state), NOWHERE

        return Task(
            name=id,
            world=KnownDynamics(pendulum_step, Manifold(2, angles=[0]), 1),
            start=begin,
            state_names=["angle", "speed"],
            action_names=["torque"],
            low=action_low or [-2.0],
            high=action_high or [2.0],
            **known,
            dt=0.05,
            steps=steps,
            observe=pendulum_observation,
        )

    def start(seed: int) -> tuple[Tensor, Tensor]:
        env.reset(seed=seed)
        return state_of(inner.data), NOWHERE

    seen = {"observe": partial(_observation_of, inner)}
    world = MuJoCoDynamics(env)
    trust(world, start(0)[0], world.action_low.tolist(), world.action_high.tolist(), EXACT)
    return simulated(id, world, start, {**known, **seen}, steps, *limits)


def _observation_of(env: Any, state: Tensor) -> Tensor:
    """Return what gymnasium's environment of a MuJoCo task shows in states, ``(*B, O)``.

    Places of bodies, as of the finger in Reacher-v5, are those of the state; gymnasium's own are
    a simulation step old. Forces, as in Ant-v5, are those of the environment's own last step.
    """
    rows = state.reshape(-1, state.shape[-1]).double().numpy()
    shown, ends = [], (env.model.nq, env.model.nq + env.model.nv)
    for row in rows:
        position, velocity, activation = np.split(row, ends)
        env.data.act[:] = activation
        env.set_state(position, velocity)
        shown.append(env._get_obs())
    return torch.from_numpy(np.stack(shown)).to(state).reshape(*state.shape[:-1], -1)
