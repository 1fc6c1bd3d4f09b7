"""The cross-entropy method by TorchRL's rule, which starts cold at every step."""

from __future__ import annotations

from typing import Annotated, Unpack

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, options
from afm_rl.planning.receding import (
    Candidates,
    Horizon,
    Iterations,
    SamplingOptions,
    SamplingPlanner,
    moments,
)


class CEM(SamplingPlanner):
    r"""Cross-entropy method as in ``torchrl.modules.CEMPlanner``, without a warm start.

    Each iteration draws plans :math:`u = \mathrm{clamp}(\mu + \sigma \odot \epsilon)`, at first
    around :math:`\mu = 0` with :math:`\sigma = 1`, independent of the action bounds, and takes mean
    and standard deviation of the best K. The action is that of the mean. If no return is finite,
    :math:`\mu` and :math:`\sigma` do not change.

    Args:
        env: batch-unlocked environment to plan in; a :class:`PlanningEnv` is fastest.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> world = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "goal": torch.ones(4, 2)}, [4])
    >>> CEM(world, horizon=5)(td)["action"].shape
    torch.Size([4, 2])
    """

    @options("planner")
    def __init__(
        self,
        env: EnvBase,
        horizon: Horizon = 5,
        candidates: Candidates = 300,
        iterations: Iterations = 3,
        elites: Annotated[Count, "best candidates, which the next iteration is fitted to, K"] = 30,
        **settings: Unpack[SamplingOptions],
    ) -> None:
        super().__init__(env, {}, horizon, candidates, iterations, **settings)
        self.elites = elites
        if elites > candidates:
            raise ConfigurationError(
                f"planner.elites={elites}: expected at most planner.candidates={candidates}"
            )
        self.register_buffer("scale", torch.ones_like(self.action_spec.space.low))

    @torch.no_grad()
    def plan(self, td: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """Return the first action of the last mean plan, and no entries to keep."""
        low, high, scale = self._bounds(td)
        mean = scale.new_zeros(*td.batch_size, self.horizon, scale.shape[-1])
        std = scale.expand_as(mean)
        for _ in range(self.iterations):
            plans = mean.unsqueeze(-3) + std.unsqueeze(-3) * self._noise(td, mean, self.candidates)
            plans = torch.minimum(torch.maximum(plans, low.unsqueeze(-2)), high.unsqueeze(-2))
            chosen, returns = self._best(td, plans, self.elites)
            # Mean and unbiased deviation of those whose return is finite.
            count = returns.isfinite().sum(-1)[..., None, None].to(plans)
            centre, spread = moments(chosen, returns.isfinite().to(plans))
            spread = spread * (count / (count - 1.0).clamp_min(1.0)).sqrt()
            mean, std = torch.where(count > 0, centre, mean), torch.where(count > 0, spread, std)
        return mean[..., 0, :], []
