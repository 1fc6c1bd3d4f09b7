"""A user's tasks: an MJCF file, or a step function; and what tasks in MuJoCo share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.envs.task.rewards import Rewards
from afm_rl.envs.task.task import NOWHERE, Reward, Task, bound_noise
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.options import Count, NonNegative, options
from afm_rl.spaces.manifold import Manifold

Limits = Sequence[float] | None
EXACT = 0.03  # share of what actions effect that a model misses which is the world's simulator


def known_of(
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
        known, within = rewards, {}
    else:
        known, within = rewards(model), {"reward_in": lambda other: rewards(other).reward}
    size = 0 if model is None else model.nq + model.nv + model.na
    features = [k for k in range(size) if k not in known.ignored] if known.ignored else []
    own = {"reward": known.reward, "plan": known.plan, "ends": known.ends, "features": features}
    return {**own, **within}


def simulated(
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


def state_of(data: Any) -> Tensor:
    """Return (qpos, qvel, act) of MuJoCo's data."""
    return torch.cat([torch.tensor(part) for part in (data.qpos, data.qvel, data.act)])


@options("robot")
def mujoco_task(
    xml: str | Path | None,
    reward: Reward | None,
    steps: Annotated[Count, "steps of an episode"] = 1000,
    frame_skip: Annotated[Count, "simulation steps per action"] = 1,
    start_noise: Annotated[NonNegative, "standard deviation of positions and velocities"] = 0.01,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task with a user's robot: an MJCF file, and a reward.

    Episodes start near the model's first keyframe, if there is one.

    Args:
        xml: file, or text that begins with ``<``.
        reward: see :class:`~afm_rl.envs.Task`.
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
    try:
        world = MuJoCoDynamics(xml, frame_skip)
    except ConfigurationError as error:
        raise ConfigurationError(str(error).replace("dynamics.model", "robot.xml")) from error
    import mujoco

    data = mujoco.MjData(world.mjcf)
    if world.mjcf.nkey:
        mujoco.mj_resetDataKeyframe(world.mjcf, data, 0)
    first, size = state_of(data), world.manifold.tangent_size

    def start(seed: int) -> tuple[Tensor, Tensor]:
        drawn = torch.randn(size, generator=torch.Generator().manual_seed(seed)).double()
        return world.manifold.add(first, start_noise * drawn), NOWHERE

    name = "mjcf" if str(xml).lstrip().startswith("<") else Path(xml).stem
    low, high = action_low or world.action_low.tolist(), action_high or world.action_high.tolist()
    bound_noise(world, first, low, high)
    return simulated(name, world, start, {"reward": reward}, steps, low, high)


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
        start_noise: standard deviation of the first state.
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
        world=bound_noise(world, first, action_low, action_high),
        start=begin,
        reward=reward,
        low=action_low,
        high=action_high,
        dt=dt,
        steps=steps,
        state_names=[f"s_{k}" for k in range(len(first))],
        action_names=[f"a_{k}" for k in range(len(action_low))],
    )
