"""Windows that a robot would have seen under imagined regimes, to refine a flow on that robot."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from afm_rl.compiling.devices import device_of
from afm_rl.correction.achievable import intend
from afm_rl.correction.base import Corrector
from afm_rl.correction.experts import LIMIT, Rows, fit_experts
from afm_rl.correction.network import midpoint
from afm_rl.correction.training.prior import Draw, Drawn, draw_actions, draw_masks
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action
from afm_rl.regimes import Regime
from afm_rl.spaces.manifold import draw_states

if TYPE_CHECKING:
    from afm_rl.correction.action_flow import ActionFlow


def draw_counterfactuals(
    corrector: Corrector,
    model: DynamicsModel,
    regime: Regime,
    states: tuple[Tensor, Tensor] | Tensor,
    size: tuple[int, int, int],
    mode: str,
    generator: torch.Generator,
) -> Drawn:
    """Draw regimes from a prior and show the model's world to a corrector through them.

    The newest rows of each window come from the regime to correct, the older ones from the regime
    before; some windows are not full. Half of the plans are in the action box, the others are
    achievable effects.

    Args:
        corrector: whose actions they are.
        model: the world, before anything happens to it.
        regime: the prior.
        states: lowest and highest state, or a pool of them, ``(P, S)``.
        size: windows, their rows and plans for each, (N, K, C).
        mode: of plans that are not achievable, see :func:`~afm_rl.correction.achievable.saturate`.
        generator: of all that is drawn.
    """
    count, rows, plans = size
    draw, axes, device = Draw(generator), corrector.action_size, device_of(model)
    now, before = regime.sample((2, count), generator).to(device)
    fresh, valid = (part.to(device) for part in draw_masks(count, rows, draw))
    parameters = torch.where(fresh == 1.0, now.unsqueeze(1), before.unsqueeze(1))
    state = draw_states(states, count * rows, generator).view(count, rows, -1)
    state = model.manifold.project(state)
    executed = draw_actions(count, rows, axes, draw).to(device)
    executed = corrector.denormalise(corrector.within(executed))
    low, high = (corrector.denormalise(end) for end in (corrector.lowest, corrector.highest))
    effect = regime.apply(executed, parameters, state)
    reached = imagine(model, state, effect, low, high, generator)
    seen = effective_action(model, state, executed, reached, corrector.scale)
    pairs = Rows(
        corrector.normalise(executed),
        corrector.normalise(seen.action).clamp(-LIMIT, LIMIT),
        (seen.std / corrector.scale).clamp_max(LIMIT),
        valid,
    )
    many = (count, plans, axes)
    here, ruled = state[:, -1:].expand(-1, plans, -1), now.unsqueeze(1).expand(-1, plans, -1)
    anywhere, other, probe = (
        corrector.denormalise(corrector.within(draw.uniform(-1.0, 1.0, *many).to(device)))
        for _ in range(3)
    )
    inside = draw.chance(0.5, count, plans, 1).to(device)
    planned = torch.where(inside, anywhere, regime.apply(other, ruled, here))
    intended = intend(regime, planned, ruled, here, low, high, mode)
    answers = planned, intended, probe, regime.apply(probe, ruled, here)
    return Drawn(
        Rows(*(part * valid for part in pairs)),
        *(corrector.normalise(part).clamp(-LIMIT, LIMIT) for part in answers),
    )


def imagine(
    model: DynamicsModel,
    state: Tensor,
    effect: Tensor,
    low: Tensor,
    high: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return noisy next states ``(*B, S)`` under effective actions, also beyond the box.

    A learned model knows nothing outside the box, so it is continued linearly from its edge.
    """
    inside = torch.minimum(torch.maximum(effect, low), high)
    expected, noise = model.forecast(state, inside)
    change = noise * torch.randn(noise.shape, generator=generator).to(noise)
    out = (effect != inside).any(-1)  # derivatives are dear, and few effects are beyond the box
    slope = model.jacobian(state[out], inside[out])
    change[out] += (slope @ (effect - inside)[out].unsqueeze(-1)).squeeze(-1)
    return model.manifold.add(expected, change)


class Windows:
    """The loss of an action flow on the windows of one robot.

    Args:
        flow: the corrector.
        plans: for each window.
    """

    def __init__(self, flow: ActionFlow, plans: int = 4) -> None:
        self.flow, self.plans = flow, plans

    def draw(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
    ) -> Drawn:
        """Return ``count`` windows with their plans and answers."""
        size = (count, self.flow.recent, self.plans)
        mode = self.flow.tick.saturation
        with torch.no_grad():
            return draw_counterfactuals(self.flow, model, regime, states, size, mode, generator)

    @torch.no_grad()
    def error(self, drawn: Drawn) -> float:
        """Return the RMS error of the flow's mean action, a share of the largest one."""
        tick, network = self.flow.tick, self.flow.network
        known = network.encode(drawn.rows, fit_experts(drawn.rows))
        least, most = (end.to(drawn.planned) for end in (self.flow.lowest, self.flow.highest))
        asked = network.ask(known, drawn.planned, tick.saturation)
        ends = midpoint(partial(network.velocity, asked), drawn.planned, tick.steps)
        return float((ends.clamp(least, most) - drawn.intended).square().mean().sqrt())
