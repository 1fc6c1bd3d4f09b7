"""Where tasks come from: gymnasium, dm_control, an MJCF file, or a step function of one's own.

Their packages are imported when they are asked for: none of them is needed for anything else.
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.dynamics.mujoco import Change
from afm_rl.dynamics.mujoco_physics import changed_model
from afm_rl.envs.task.hosts import environment_task
from afm_rl.envs.task.pendulum import pendulum_observation, pendulum_step
from afm_rl.envs.task.rewards import DM_CONTROL, GYMNASIUM, Rewards, seen_target
from afm_rl.envs.task.task import NOWHERE, Reward, Task, trust
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.spaces.manifold import Manifold

Limits = Sequence[float] | None
EXACT = 0.03  # the same, of a model that is the world's simulator


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
    known = _known("robot.id", id, GYMNASIUM, reward, getattr(inner, "model", None))
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
        return _state_of(inner.data), NOWHERE

    seen = {"observe": partial(_observation_of, inner)}
    world = MuJoCoDynamics(env)
    trust(world, start(0)[0], world.action_low.tolist(), world.action_high.tolist(), EXACT)
    return _mujoco(id, world, start, {**known, **seen}, steps, *limits)


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
        ConfigurationError: if there is no dm_control, no such task, or nothing is known of it.
    """
    draws = np.random.RandomState()
    with quiet():
        try:
            from dm_control import suite

            env = suite.load(domain, task, task_kwargs={"random": draws})
        except ImportError as error:
            raise ConfigurationError(
                "robot=dm_control: the package dm_control is missing; install afm-rl[dm_control]"
            ) from error
        except ValueError as error:
            raise ConfigurationError(f"robot.domain={domain} robot.task={task}: {error}") from error
    known = _known(
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
        return _state_of(env.physics.data), torch.tensor(np.array(goal))

    goals = {"goal_names": ["target_x", "target_y"], "goal_in": seen_target} if targets else {}
    limits = action_low, action_high
    world = MuJoCoDynamics(env, change=change)
    return _mujoco(f"{domain}_{task}", world, start, {**known, **goals}, steps, *limits)


def mujoco_task(
    xml: str | Path | None,
    reward: Reward | None,
    steps: int = 1000,
    frame_skip: int = 1,
    start_noise: float = 0.01,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task with a robot of one's own: an MJCF file, and a reward.

    Args:
        xml: file, or text that begins with ``<``.
        reward: see :class:`~afm_rl.envs.Task`.
        steps: length of an episode.
        frame_skip: simulation steps per action.
        start_noise: standard deviation of positions and velocities at the start, around the
            model's own (its first keyframe if it has one).
        action_low: lowest action; the actuators' control range if None.
        action_high: highest action.

    Raises:
        ConfigurationError: for a file or a setting that cannot be used.
    """
    if xml is None or reward is None:
        missing = "robot.xml" if xml is None else "robot.reward"
        raise ConfigurationError(
            f"{missing}: expected a setting; robot=mujoco needs robot.xml=FILE and "
            "robot.reward=MODULE.FUNCTION"
        )
    noise = check_number("robot.start_noise", start_noise, low=0.0)
    skip = check_count("robot.frame_skip", frame_skip)
    try:
        world = MuJoCoDynamics(xml, skip)
    except ConfigurationError as error:
        raise ConfigurationError(str(error).replace("dynamics.model", "robot.xml")) from error
    import mujoco

    data = mujoco.MjData(world.mjcf)
    if world.mjcf.nkey:
        mujoco.mj_resetDataKeyframe(world.mjcf, data, 0)
    first, size = _state_of(data), world.manifold.tangent_size

    def start(seed: int) -> tuple[Tensor, Tensor]:
        drawn = torch.randn(size, generator=torch.Generator().manual_seed(seed)).double()
        return world.manifold.add(first, noise * drawn), NOWHERE

    name = "mjcf" if str(xml).lstrip().startswith("<") else Path(xml).stem
    low, high = action_low or world.action_low.tolist(), action_high or world.action_high.tolist()
    trust(world, first, low, high)
    return _mujoco(name, world, start, {"reward": reward}, steps, low, high)


def function_task(
    step: Callable[[Tensor, Tensor], Tensor],
    reward: Reward,
    action_low: Sequence[float],
    action_high: Sequence[float],
    start: Sequence[float],
    start_noise: float = 0.01,
    angles: Sequence[int] = (),
    steps: int = 1000,
    dt: float = 0.1,
) -> Task:
    """Return a task whose world is a step function.

    Args:
        step: ``step(state, action) -> next_state``, batched.
        reward: see :class:`~afm_rl.envs.Task`.
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        start: first state, ``(S,)``.
        start_noise: its standard deviation.
        angles: state coordinates that wrap at +-pi.
        steps: length of an episode.
        dt: time of a step (s).
    """
    first = torch.tensor([float(value) for value in start])

    def begin(seed: int) -> tuple[Tensor, Tensor]:
        drawn = torch.randn(len(first), generator=torch.Generator().manual_seed(seed))
        return first + start_noise * drawn, NOWHERE

    world = KnownDynamics(step, Manifold(len(first), angles), len(action_low))
    return Task(
        name=getattr(step, "__name__", "function"),
        world=trust(world, first, action_low, action_high),
        start=begin,
        reward=reward,
        low=action_low,
        high=action_high,
        dt=dt,
        steps=steps,
        state_names=[f"s_{k}" for k in range(len(first))],
        action_names=[f"a_{k}" for k in range(len(action_low))],
    )


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


def _known(
    place: str, name: str, table: Mapping[str, Any], reward: Reward | None, model: Any
) -> dict[str, Any]:
    """Return what a table says of a task; of others, the user's reward is all."""
    if reward is not None:
        return {"reward": reward}
    if name not in table:
        raise ConfigurationError(
            f"{place}={name}: its reward is not known as a function of states; give "
            "robot.reward=MODULE.FUNCTION"
        )
    rewards = table[name]
    if isinstance(rewards, Rewards):
        found, within = rewards, {}
    else:
        found, within = rewards(model), {"reward_in": lambda other: rewards(other).reward}
    size = 0 if model is None else model.nq + model.nv + model.na
    features = [k for k in range(size) if k not in found.ignored] if found.ignored else []
    own = {"reward": found.reward, "plan": found.plan, "ends": found.ends, "features": features}
    return {**own, **within}


def _mujoco(
    name: str,
    world: MuJoCoDynamics,
    start: Callable[[int], tuple[Tensor, Tensor]],
    known: Mapping[str, Any],
    steps: int,
    low: Limits,
    high: Limits,
) -> Task:
    """Return a task in a MuJoCo world."""
    states, actions = world.names
    return Task(
        name=name,
        world=world,
        start=start,
        state_names=states,
        action_names=actions,
        low=world.action_low.tolist() if low is None else low,
        high=world.action_high.tolist() if high is None else high,
        dt=world.dt,
        steps=check_count("robot.steps", steps),
        **known,
    )


def _state_of(data: Any) -> Tensor:
    """Return (qpos, qvel, act) of MuJoCo's data."""
    return torch.cat([torch.tensor(part) for part in (data.qpos, data.qvel, data.act)])


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
