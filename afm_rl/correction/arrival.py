r"""Where a robot will be when its next command acts.

Commands that act late cannot be undone by others. But policy or planner can be asked about the
state in which their command will act (Smith 1957, Chem. Eng. Progress 53): the model is rolled
through the effects of the commands that are still under way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold, may_look
from afm_rl.dynamics import DynamicsModel

if TYPE_CHECKING:
    from afm_rl.correction.base import Corrector

LEAST = 1e-3  # share of the best that every delay keeps on every axis: none decides alone


def steps_late(weights: Tensor, prior: Tensor, so_late: Tensor) -> Tensor:
    r"""Return the most probable delay of commands in steps, ``(*B)``.

    .. math:: k = \operatorname{argmax}_k \log p_k + \sum_a \log\frac{p_{ka}}{p_k}

    One for all axes, from the evidence of all: an axis whose commands hardly change shows none.
    None while *nothing has changed* is believed everywhere; else it is as probable, a priori, as
    all else that is not late.

    Args:
        weights: probabilities of the models on every axis, ``(*B, M, A)``.
        prior: log-odds of the models, ``(M, 1)``.
        so_late: by which models actions are k steps late, ``(K + 1, M)``, 0 or 1.

    >>> weights = torch.tensor([[0.8, 0.1], [0.1, 0.8], [0.1, 0.1]])
    >>> even = torch.zeros(3, 1)
    >>> steps_late(weights, even, torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]))
    tensor(1)
    """
    among, share = so_late.to(weights), prior.to(weights).softmax(-2)
    even = (among[:1, 1:] @ share[1:] / share[:1]).clamp_max(1.0)
    even = torch.cat([even, torch.ones_like(share[1:])])  # against the odds of the first model
    first = among @ (even * share)
    evidence = among @ (even * weights) / first.clamp_min(1e-30)
    evidence = (evidence / evidence.amax(-2, keepdim=True)).clamp_min(LEAST)
    found = (first.log() + evidence.log().sum(-1, keepdim=True)).squeeze(-1).argmax(-1)
    return torch.where((weights[..., 0, :] < 0.5).any(-1), found, 0)


def effects_of(models: Tensor, weights: Tensor, late: Tensor, so_late: Tensor) -> Tensor:
    """Return the effects ``(*B, K, A)`` of commands by those models that are so late.

    Args:
        models: their effects by every model, ``(*B, M, K, A)``.
        weights: probabilities of the models, ``(*B, M, A)``.
        late: steps, ``(*B)``.
        so_late: by which models actions are k steps late, ``(K + 1, M)``, 0 or 1.
    """
    among = so_late.to(weights)[late].unsqueeze(-1) * weights.clamp_min(1e-9)
    among = among / among.sum(-2, keepdim=True)
    return (among.unsqueeze(-2) * models).sum(-3)


def arrival(corrector: Corrector, memory: Tensor, model: DynamicsModel) -> tuple[Tensor, Tensor]:
    """Return the state ``(*B, S)`` in which the next command will act, and in how many steps.

    The present state where no command is late, or where the model leads to no number.

    Args:
        corrector: whose memory it is.
        memory: up to the present state, ``(*B, P)``.
        model: the dynamics model as it is now.
    """
    with torch.no_grad():
        state, effects, steps = corrector.under_way(memory)
        if not effects.shape[-2] or all_hold(steps == 0):
            return state, steps
        most = int(steps.max()) if may_look(steps) else effects.shape[-2]
        # Every mission's commands under way, the oldest first; what follows them is not looked at.
        ages = effects.shape[-2] - steps.unsqueeze(-1) + torch.arange(most, device=steps.device)
        ages = ages.clamp_max(effects.shape[-2] - 1).unsqueeze(-1)
        plan = effects.gather(-2, ages.expand(*ages.shape[:-1], effects.shape[-1]))
        states = model.rollout(state, plan.unsqueeze(-3)).squeeze(-3)
        last = (steps - 1).clamp_min(0)[..., None, None].expand(*steps.shape, 1, state.shape[-1])
        found = states.gather(-2, last).squeeze(-2).to(state)
        late = (steps > 0).unsqueeze(-1) & found.isfinite().all(-1, keepdim=True)
        return torch.where(late, found, state), steps
