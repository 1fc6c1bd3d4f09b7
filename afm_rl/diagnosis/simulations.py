"""What a robot may do between the simulation steps of an action, and what an MJCF may lack."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from afm_rl.dynamics import MuJoCoDynamics


def other_simulations(
    model: MuJoCoDynamics, state: Tensor, last: Tensor, action: Tensor
) -> Iterator[tuple[str, Tensor]]:
    """Yield what a simulated robot may do instead, and the states ``(N, S)`` that it leads to.

    Args:
        model: a simulation of some steps an action.
        state: ``(N, S)``.
        last: actions a step earlier, ``(N, A)``.
        action: those that are told.
    """
    simulator: Any = model.step
    mjcf, skip, *_ = simulator.settings
    fine, share = _simulating(model, mjcf, 1), torch.arange(1.0, skip + 1) / skip
    new = {f"acts {k / skip:.2g} steps late": 1.0 * (share > k / skip) for k in range(1, skip)}
    new["interpolates between commands over a step"] = share
    for cause, weight in new.items():
        plan = torch.lerp(last.unsqueeze(-2), action.unsqueeze(-2), weight.unsqueeze(-1).to(action))
        yield cause, fine.rollout(state, plan.unsqueeze(-3))[:, 0, -1]
    held = action[:, None, None].expand(-1, 1, skip, -1)
    for count, there in enumerate(fine.rollout(state, held)[:, 0, :-1].unbind(-2), 1):
        yield f"makes {count} of the {skip} steps of the simulation (frame_skip, dt)", there
    wide = copy.copy(mjcf)
    wide.jnt_range[wide.jnt_type == 3] *= 180 / math.pi  # of hinges
    cause = 'turns 57.3 times as far to its stops (an MJCF without angle="radian")'
    yield cause, _simulating(model, wide, skip)(state, action)


def _simulating(model: MuJoCoDynamics, mjcf: Any, skip: int) -> MuJoCoDynamics:
    """Return the dynamics model with another simulation."""
    simulator: Any = model.step
    other = copy.copy(model)
    other.step = type(simulator)(mjcf, skip, *simulator.settings[2:])
    return other
