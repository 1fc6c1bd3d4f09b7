"""What tasks in MuJoCo share, whatever package they come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.envs.task.rewards import Rewards
from afm_rl.envs.task.task import Reward, Task
from afm_rl.errors import ConfigurationError, check_count

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
        found, within = rewards, {}
    else:
        found, within = rewards(model), {"reward_in": lambda other: rewards(other).reward}
    size = 0 if model is None else model.nq + model.nv + model.na
    features = [k for k in range(size) if k not in found.ignored] if found.ignored else []
    own = {"reward": found.reward, "plan": found.plan, "ends": found.ends, "features": features}
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
