"""Tasks of gymnasium and of dm_control's suite."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.dynamics.mujoco import Change
from afm_rl.dynamics.mujoco_model import changed_model
from afm_rl.envs.task.hosts import environment_task
from afm_rl.envs.task.own import EXACT, Limits, known_of, simulated, state_of
from afm_rl.envs.task.rewards import (
    DM_CONTROL,
    GYMNASIUM,
    pendulum_observation,
    pendulum_step,
    seen_target,
)
from afm_rl.envs.task.task import NOWHERE, Reward, Task, bound_noise
from afm_rl.errors import ConfigurationError, refusing
from afm_rl.spaces.manifold import Manifold
from afm_rl.trust import check_name, restricted


@contextmanager
def quiet() -> Iterator[None]:
    """Silence what packages say of missing screens, and of old settings in files of theirs."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings(), _deprecations_of_mujoco_unsaid():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logger.setLevel(level)
            absl: Any = sys.modules.get("absl.logging")
            if absl is not None:  # it would close what stood for stderr when it was imported
                absl.get_absl_handler().python_handler.stream = sys.__stderr__


@contextmanager
def _deprecations_of_mujoco_unsaid() -> Iterator[None]:
    try:
        from mujoco import get_mju_user_warning, set_mju_user_warning
    except ImportError:  # an extra
        yield
        return
    before = get_mju_user_warning()
    tell = partial(print, file=sys.stderr) if before is None else before
    set_mju_user_warning(lambda text: None if "deprecated" in text else tell(text))
    try:
        yield
    finally:
        set_mju_user_warning(before)


def gymnasium_task(
    id: str,  # noqa: A002 - what gymnasium calls it
    reward: Reward | None = None,
    steps: int | None = None,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task of gymnasium.

    For MuJoCo tasks and Pendulum-v1 the full state and the physics are known. For other tasks the
    state is the observation, and a model must be learned, see
    :func:`~afm_rl.envs.environment_task`.

    Args:
        id: name in gymnasium's registry.
        reward: in torch, see :class:`~afm_rl.envs.Task`; the task's own if None and known.
        steps: length of an episode; the registered one if None.
        action_low: lowest action; the task's if None.
        action_high: highest action.

    Raises:
        ConfigurationError: if there is no such task, its actions are discrete, nothing is known
            about it, or settings name a module (``MODULE:NAME``) that is not trusted.

    >>> gymnasium_task("Pendulum-v1").state_names
    ['angle', 'speed']
    """
    import gymnasium

    module, colon, _ = str(id).partition(":")
    if colon and restricted():  # gymnasium imports it
        check_name("robot.id", module)
    with refusing(f"robot.id={id!r}"), quiet():
        env = gymnasium.make(id)
    limits = action_low, action_high
    steps = steps or (env.spec.max_episode_steps if env.spec else None) or 1000
    inner: Any = env.unwrapped
    if not hasattr(inner, "model") and id not in GYMNASIUM:
        from torchrl.envs import GymEnv

        make = partial(GymEnv, id)
        return environment_task(make, reward, steps, 0.05, "observation", *limits, id)
    known = known_of("robot.id", id, GYMNASIUM, reward, getattr(inner, "model", None))
    if id == "Pendulum-v1":
        return _pendulum(env, known, steps, *limits)

    def start(seed: int) -> tuple[Tensor, Tensor]:
        env.reset(seed=seed)
        return state_of(inner.data), NOWHERE

    seen = {"observe": partial(_observation_of, inner)}
    world = MuJoCoDynamics(env)
    bound_noise(world, start(0)[0], world.action_low.tolist(), world.action_high.tolist(), EXACT)
    return simulated(id, world, start, {**known, **seen}, steps, *limits)


def _pendulum(env: Any, known: dict[str, Any], steps: int, low: Limits, high: Limits) -> Task:
    """Return gymnasium's pendulum, the only task of its own that has a state and no MuJoCo."""

    def start(seed: int) -> tuple[Tensor, Tensor]:
        env.reset(seed=seed)
        return torch.tensor(env.unwrapped.state), NOWHERE

    return Task(
        name="Pendulum-v1",
        world=KnownDynamics(pendulum_step, Manifold(2, angles=[0]), 1),
        start=start,
        state_names=["angle", "speed"],
        action_names=["torque"],
        low=low or [-2.0],
        high=high or [2.0],
        **known,
        dt=0.05,
        steps=steps,
        observe=pendulum_observation,
    )


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


def dm_control_task(
    domain: str,
    task: str,
    reward: Reward | None = None,
    steps: int = 1000,
    action_low: Limits = None,
    action_high: Limits = None,
    change: Change = changed_model,
) -> Task:
    """Return a task of dm_control's suite.

    Args:
        domain: such as ``reacher``.
        task: such as ``hard``.
        reward: see :func:`gymnasium_task`.
        steps: length of an episode.
        action_low: lowest action; the task's if None.
        action_high: highest action.
        change: see :class:`~afm_rl.dynamics.MuJoCoDynamics`.

    Raises:
        ConfigurationError: if there is no dm_control, no such task, or nothing is known about it.
    """
    draws = np.random.RandomState()
    with quiet():
        try:
            from dm_control import suite

            env = suite.load(domain, task, task_kwargs={"random": draws})
        except ImportError as error:
            raise ConfigurationError(
                "robot=dm_control: no dm_control; install afm-rl[dm_control] (below Python 3.13)"
            ) from error
        except ValueError as error:
            raise ConfigurationError(f"robot.domain={domain} robot.task={task}: {error}") from error
    known = known_of(
        f"robot.domain={domain} robot.task",
        task,
        DM_CONTROL.get(domain, {}),
        reward,
        env.physics.model,
    )
    targets = domain == "reacher"

    def start(seed: int) -> tuple[Tensor, Tensor]:
        draws.seed(seed % 2**32)
        env.reset()
        goal = env.physics.named.model.geom_pos["target", :2] if targets else ()
        return state_of(env.physics.data), torch.tensor(np.array(goal))

    goals = {"goal_names": ["target_x", "target_y"], "goal_in": seen_target} if targets else {}
    limits = action_low, action_high
    world = MuJoCoDynamics(env, change=change)
    return simulated(f"{domain}_{task}", world, start, {**known, **goals}, steps, *limits)
