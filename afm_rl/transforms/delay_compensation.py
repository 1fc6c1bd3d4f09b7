"""Compensation of delays: policy or planner acts for the state in which its action will act.

No other action can undo a delay. But the policy can be given the state in which its action will act
(Smith 1957, Chem. Eng. Progress 53): the model predicts it from the actions that have yet to act.
"""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.compiling.tracing import may_look, none_holds
from afm_rl.correction import Corrector
from afm_rl.correction.base import Fields
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import only

UNKNOWN = (
    "what is observed in the state in which they act is not known; {}, or delay_compensation=False"
)


@torch.no_grad()
def state_at_arrival(
    corrector: Corrector, memory: Fields, model: DynamicsModel, steps: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the state ``(*B, S)`` in which the next action will act, and in how many steps.

    The present state and 0 where no action is late, or where the model leads to no number.

    Args:
        corrector: whose memory it is.
        memory: up to the present state.
        model: the dynamics model as it is now.
        steps: how late the next action is, such as ``corrector.delay_in(memory)``, ``(*B)``.
    """
    state, effects = memory["state"], corrector.under_way(memory)
    if none_holds(steps) or not effects.shape[-2]:
        return state, steps
    most = int(steps.max()) if may_look(steps) else effects.shape[-2]
    # Every mission's actions under way, the oldest first; what follows them is not looked at.
    order, late = torch.arange(most, device=steps.device), steps.unsqueeze(-1)
    ages = effects.shape[-2] - late + order
    ages = ages.clamp_max(effects.shape[-2] - 1).unsqueeze(-1)
    plan = effects.gather(-2, ages.expand(*ages.shape[:-1], effects.shape[-1]))
    plan = only((order < late).unsqueeze(-1), plan, model)
    states = model.rollout(state, plan.unsqueeze(-3)).squeeze(-3)
    last = (steps - 1).clamp_min(0)[..., None, None].expand(*steps.shape, 1, state.shape[-1])
    reached = states.gather(-2, last).squeeze(-2).to(state)
    steps = torch.where(reached.isfinite().all(-1), steps, 0)
    return torch.where((steps > 0).unsqueeze(-1), reached, state), steps
