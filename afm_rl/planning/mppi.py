"""Model predictive path integral control."""

from __future__ import annotations

from typing import Annotated, Literal, Unpack

import torch
from annotated_types import Le
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.options import NonNegative, Positive, options
from afm_rl.planning.receding import (
    Candidates,
    Horizon,
    Iterations,
    SamplingOptions,
    SamplingPlanner,
    action_spec_of,
)

CUT = 2.0  # standard deviations at which noise is cut off
MEMORY = "mppi", "mean"  # where the mean plan is kept


def smooth(
    plan: Tensor, past: Tensor, beta: float, low: Tensor, high: Tensor, within: bool = True
) -> Tensor:
    r"""Filter plans x ``(*B, H, A)`` in time, within the action bounds; ``beta`` 1 does not smooth.

    .. math:: u_h = \mathrm{clamp}(\beta\,x_h + (1 - \beta)\,u_{h-1}),\qquad u_{-1} = u_\text{past}

    Where not ``within``, all is clamped after the last step, and :math:`u_{h-1}` may be outside.

    >>> bounds = -torch.ones(1), torch.ones(1)
    >>> smooth(torch.tensor([[1.0], [1.0], [9.0]]), torch.zeros(1), 0.5, *bounds).squeeze(-1)
    tensor([0.5000, 0.7500, 1.0000])
    """
    if beta == 1.0:
        return plan.clamp(rows_like(low, plan), rows_like(high, plan))
    steps = plan.movedim(-1, 0).movedim(-1, 0).clone(memory_format=torch.contiguous_format)
    steps *= beta  # (H, A, *B): what one step needs lies together
    past, low, high = (
        part.expand(*plan.shape[:-2], -1).movedim(-1, 0).contiguous() for part in (past, low, high)
    )
    for now in steps.unbind(0):
        past = now.add_(past, alpha=1.0 - beta)
        if within:
            past.clamp_(low, high)
    if not within:
        steps.clamp_(low, high)
    return steps.movedim(1, -1).movedim(0, -2)


def rows_like(values: Tensor, plan: Tensor) -> Tensor:
    """Return values of the actions, ``(A,)`` or ``(*B, A)``, for each step of plans ``(*B, H, A)``.

    Written out: operations that repeat a row of two or three numbers are several times slower.

    >>> rows_like(torch.tensor([1.0, 2.0]), torch.zeros(7, 3, 2)).tolist()
    [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]
    """
    return values.unsqueeze(-2).expand(*values.shape[:-1], *plan.shape[-2:]).contiguous()


def path_weights(returns: Tensor, temperature: float) -> Tensor:
    r"""Return :math:`w_i \propto \exp(R_i / \lambda)` over the last dimension.

    Returns that are not finite weigh nothing; where none is finite all weights are zero.

    >>> path_weights(torch.tensor([0.0, 0.0, torch.nan, torch.inf]), 1.0)
    tensor([0.5000, 0.5000, 0.0000, 0.0000])
    """
    finite = returns.isfinite()
    logits = torch.where(finite, returns, -torch.inf)
    best = logits.amax(-1, keepdim=True)
    best = torch.where(best.isfinite(), best, 0.0)
    weights = ((logits - best) / temperature).exp()
    return weights / weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)


class MPPI(SamplingPlanner):
    r"""MPPI with a warm-started mean plan, smoothed noise and log-sum-exp weights.

    Each step shifts the mean plan by one, draws N candidates around it,

    .. math:: u^i_h = \mathrm{clamp}(\beta\,(\bar u_h + \sigma\,\epsilon^i_h)
              + (1-\beta)\,u^i_{h-1}),

    rolls them out in the planning environment, and moves the mean to
    :math:`\sum_i w_i u^i`, :math:`w_i \propto \exp(R_i / \lambda)` (Nagabandi et al. 2020,
    section 4.3; paper, section III-A). The action is the first one of the mean, for every
    exploration type, because the candidates already explore.

    The mean lives in the tensordict, so every mission of a batch has its own, and resets
    clear it: append :meth:`make_tensordict_primer` to the environment.

    The published runs used ``noise="unit"``, ``past="shifted"`` and ``clamp="end"``.

    Args:
        env: batch-unlocked environment to plan in; a :class:`PlanningEnv` is fastest.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> world = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> planner = MPPI(world, horizon=5, candidates=64)
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "goal": torch.ones(4, 2)}, [4])
    >>> planner(td.set(("mppi", "mean"), torch.zeros(4, 5, 2)))["action"].shape
    torch.Size([4, 2])
    """

    @options("planner")
    def __init__(
        self,
        env: EnvBase,
        horizon: Horizon = 5,
        candidates: Candidates = 300,
        iterations: Iterations = 1,
        temperature: Annotated[Positive, "lambda, in units of the return"] = 0.001,
        sigma: Annotated[NonNegative, Le(100), "noise, in half ranges of each action"] = 1.0,
        beta: Annotated[Positive, Le(1), "weight of the new action in the smoothing"] = 0.6,
        noise: Annotated[
            Literal["scaled", "unit"], "scaled: by sigma; unit: standard deviation 1"
        ] = "scaled",
        past: Annotated[
            Literal["previous", "shifted"],
            "previous: smoothing starts from the previous action; shifted: from the shifted plan",
        ] = "previous",
        clamp: Annotated[
            Literal["within", "end"],
            "within: smoothing continues from the clamped action; end: all are clamped after it",
        ] = "within",
        **settings: Unpack[SamplingOptions],
    ) -> None:
        memory = {MEMORY: (horizon, *action_spec_of(env).shape)}
        super().__init__(env, memory, horizon, candidates, iterations, **settings)
        self.temperature, self.sigma, self.beta = temperature, sigma, beta
        self.noise, self.past, self.clamp = noise, past, clamp
        space = self.action_spec.space
        half = (space.high - space.low) / 2
        self.register_buffer("scale", sigma * half if noise == "scaled" else torch.ones_like(half))

    @torch.no_grad()
    def plan(self, td: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """Return the first action of the new mean plan ``(*B, H, A)``, and that plan."""
        (mean,) = self._recall(td)
        shifted = torch.cat([mean[..., 1:, :], mean[..., -1:, :]], -2)
        past = (mean if self.past == "previous" else shifted)[..., 0, :]
        low, high, scale = self._bounds(td)
        best = shifted
        for _ in range(self.iterations):
            eps = self._noise(td, mean, self.candidates, CUT)
            raw = eps.mul_(rows_like(scale, eps)).add_(best.unsqueeze(-3))
            within = self.clamp == "within"
            plans = smooth(raw, past.unsqueeze(-2), self.beta, low, high, within)
            returns = self._returns(td, plans)
            some = returns.isfinite().any(-1)[..., None, None]
            best = torch.where(some, self._mean(returns, plans), best)
        return best[..., 0, :], [best]

    def _mean(self, returns: Tensor, plans: Tensor) -> Tensor:
        weights = path_weights(returns, self.temperature).unsqueeze(-1)
        return (plans.flatten(-2).mT @ weights).squeeze(-1).unflatten(-1, plans.shape[-2:])
