"""An arm with seven joints in MuJoCo, whose actions are the positions that its servos are told."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.envs.task.own import EXACT, Limits, simulated
from afm_rl.envs.task.task import Reward, Task, bound_noise

JOINTS = 7


def chain(model: Any, site: str) -> tuple[Tensor, Tensor]:
    """Return offsets ``(N + 1, 3)`` (m) and axes ``(N, 3)`` of a chain of N hinges up to a site.

    Each body has one hinge at its origin and is parallel to its parent when all angles are zero.
    """
    places = np.stack([*model.body_pos[1:], model.site(site).pos])
    return torch.from_numpy(places), torch.from_numpy(model.jnt_axis.copy())


def tip_of(angles: Tensor, offsets: Tensor, axes: Tensor) -> Tensor:
    """Return where the tip of a chain is (m), ``(*B, 3)``, of joint angles ``(*B, N)`` (rad).

    >>> offsets, axes = torch.tensor([[0.0, 0, 1], [1, 0, 0]]), torch.tensor([[0.0, 0, 1]])
    >>> tip_of(torch.tensor([torch.pi / 2]), offsets, axes).round(decimals=4)
    tensor([0., 1., 1.])
    """
    turned = torch.eye(3).to(angles)
    place = offsets[0].to(angles)
    for axis, offset, angle in zip(axes, offsets[1:], angles.unbind(-1), strict=True):
        turned = turned @ roma.rotvec_to_rotmat(axis.to(angles) * angle.unsqueeze(-1))
        place = place + turned @ offset.to(angles)
    return place


def miss(
    state: Tensor, action: Tensor, after: Tensor, goal: Tensor, offsets: Tensor, axes: Tensor
) -> Tensor:
    """Reward: minus the distance (m) of the tip from where the goal's joint angles bring it."""
    angles = after[..., : len(axes)]
    return -(tip_of(angles, offsets, axes) - tip_of(goal, offsets, axes)).norm(dim=-1)


def arm_task(
    reward: Reward | None = None,
    steps: int = 100,
    action_low: Limits = None,
    action_high: Limits = None,
    spread: float = 0.5,
) -> Task:
    """Return the task: move the joints to random angles, and stay there.

    The state has the joints' angles (rad) and speeds (rad/s); actions are the commanded angles of
    their servos. The model's error counts as at most 3 % of the effect of actions in a step.

    Args:
        reward: reward for planning and results; the tip's distance (m) from its goal, negative, if
            None.
        steps: length of an episode, of 50 ms each.
        action_low: lowest angles; -2 rad if None.
        action_high: highest angles.
        spread: of goals around the middle pose (rad).

    >>> arm_task().start(3)[1].shape
    torch.Size([7])
    """
    import mujoco

    mjcf = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("arm.xml")))
    world = MuJoCoDynamics(mjcf, 5)  # of 10 ms each
    data = mujoco.MjData(world.mjcf)
    mujoco.mj_resetDataKeyframe(world.mjcf, data, 0)
    first = torch.cat([torch.tensor(data.qpos), torch.zeros(JOINTS)]).float()

    def start(seed: int) -> tuple[Tensor, Tensor]:
        drawn = 2 * torch.rand(JOINTS, generator=torch.Generator().manual_seed(seed)) - 1
        return first, first[:JOINTS] + spread * drawn

    low = world.action_low.tolist() if action_low is None else action_low
    high = world.action_high.tolist() if action_high is None else action_high
    bound_noise(world, first, low, high, EXACT)
    offsets, axes = chain(world.mjcf, "tip")
    known = {
        "reward": partial(miss, offsets=offsets, axes=axes) if reward is None else reward,
        "goal_names": world.names[0][:JOINTS],
    }
    return simulated("arm", world, start, known, steps, low, high)
