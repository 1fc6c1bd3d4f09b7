"""Tasks of dm_control's suite."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.dynamics.mujoco import Change
from afm_rl.dynamics.mujoco_physics import changed_model
from afm_rl.envs.task.quiet import quiet
from afm_rl.envs.task.rewards import DM_CONTROL, seen_target
from afm_rl.envs.task.simulated import Limits, known_of, simulated, state_of
from afm_rl.envs.task.task import Reward, Task
from afm_rl.errors import ConfigurationError


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
