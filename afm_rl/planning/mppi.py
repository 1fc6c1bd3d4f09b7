"""Model predictive path integral control."""

from __future__ import annotations

import warnings

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules.planners.common import (
    MPCPlannerBase,
    _mask_post_done_reward,
    _planning_done_keys,
)

from afm_rl.errors import ConfigurationError, check_choice, check_count, check_number
from afm_rl.keys import as_key
from afm_rl.planning.primer import ZeroPrimer
from afm_rl.streams import Streams

BOUND = 2.0  # exploration noise is truncated at two standard deviations


def smooth(plan: Tensor, past: Tensor, beta: float, low: Tensor, high: Tensor) -> Tensor:
    r"""Filter plans in time, within the action box.

    .. math:: u_h = \mathrm{clamp}(\beta\,x_h + (1 - \beta)\,u_{h-1}),\qquad u_{-1} = u_\text{past}

    Args:
        plan: raw actions x, ``(*B, H, A)``.
        past: the action before the plan, broadcastable to ``(*B, A)``.
        beta: weight of the new action in (0, 1]; 1 does not smooth.
        low: lowest action, ``(A,)``.
        high: highest action, ``(A,)``.

    >>> box = -torch.ones(1), torch.ones(1)
    >>> smooth(torch.tensor([[1.0], [1.0], [9.0]]), torch.zeros(1), 0.5, *box).squeeze(-1)
    tensor([0.5000, 0.7500, 1.0000])
    """
    smoothed = []
    for raw in (beta * plan).unbind(-2):
        past = torch.minimum(torch.maximum(raw + (1.0 - beta) * past, low), high)
        smoothed.append(past)
    return torch.stack(smoothed, -2)


def path_weights(returns: Tensor, temperature: float) -> Tensor:
    r"""Return :math:`w_i \propto \exp(R_i / \lambda)` over the last dimension.

    Returns that are not finite weigh nothing; where none is finite all weights are zero.

    >>> path_weights(torch.tensor([0.0, 0.0, float("nan")]), 1.0)
    tensor([0.5000, 0.5000, 0.0000])
    """
    finite = returns.isfinite()
    logits = torch.where(finite, returns, -torch.inf)
    best = logits.amax(-1, keepdim=True)
    best = torch.where(best.isfinite(), best, 0.0)
    weights = ((logits - best) / temperature).exp()
    return weights / weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)


class MPPI(MPCPlannerBase):
    r"""MPPI with a warm-started mean plan, smoothed noise and log-sum-exp weights.

    Each step shifts the mean plan by one, draws N candidates around it,

    .. math:: u^i_h = \mathrm{clamp}(\beta\,(\bar u_h + \sigma\,\epsilon^i_h)
              + (1-\beta)\,u^i_{h-1}),

    rolls them out in the planning environment, and moves the mean to
    :math:`\sum_i w_i u^i`, :math:`w_i \propto \exp(R_i / \lambda)` (Nagabandi et al. 2020,
    section 4.3; paper, section III-A). The action is the mean's first row.

    The mean lives in the tensordict, so every mission of a batch has its own and resets
    start afresh: append :meth:`make_tensordict_primer` to the environment.

    Args:
        env: batch-unlocked environment to plan in; a :class:`PlanningEnv` is fastest.
        horizon: steps of a plan, H.
        population: candidates per iteration, N.
        iterations: refinements per step.
        temperature: :math:`\lambda`, in units of the return.
        sigma: standard deviation of the noise, as a fraction of the half range of each
            action (``noise="scaled"``).
        beta: weight of the new action in the smoothing, in (0, 1].
        noise: ``"scaled"``, or ``"unit"``: standard deviation 1 whatever the action's unit,
            as in the published runs, where sigma had no effect.
        past: the action that smoothing starts from: ``"previous"``, the one last planned,
            or ``"shifted"``, the first of the shifted mean, as in the published runs.
        backend: ``"fast"`` uses ``env.returns``, ``"env"`` steps the environment, ``None``
            takes the fast way where there is one. Both give the same plans.
        mean_key: where the mean plan is kept.
        seed_key: entry ``(*B)`` with each mission's seed: missions of one seed share their
            noise whoever else is in the batch. Without it noise is drawn for the batch.
        action_key: where the action goes.
        seed: seed of the noise without ``seed_key``.

    Returns that are not finite are ignored and counted in :attr:`discarded`; where all are,
    the shifted plan stands and a warning is given.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> world = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> planner = MPPI(world, horizon=5, population=64)
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "goal": torch.ones(4, 2)}, [4])
    >>> planner(td.set(("mppi", "mean"), torch.zeros(4, 5, 2)))["action"].shape
    torch.Size([4, 2])
    """

    def __init__(
        self,
        env: EnvBase,
        horizon: int = 5,
        population: int = 300,
        iterations: int = 1,
        temperature: float = 0.001,
        sigma: float = 1.0,
        beta: float = 0.6,
        noise: str = "scaled",
        past: str = "previous",
        backend: str | None = None,
        mean_key: NestedKey = ("mppi", "mean"),
        seed_key: NestedKey | None = None,
        action_key: NestedKey = "action",
        seed: int = 0,
    ) -> None:
        super().__init__(env, action_key=as_key(action_key))
        self.horizon = check_count("planner.horizon", horizon)
        self.population = check_count("planner.population", population)
        self.iterations = check_count("planner.iterations", iterations)
        self.temperature = check_number("planner.temperature", temperature, low=0, open_low=True)
        self.sigma = check_number("planner.sigma", sigma, low=0.0)
        self.beta = check_number("planner.beta", beta, low=0.0, high=1.0, open_low=True)
        self.noise = check_choice("planner.noise", noise, ("scaled", "unit"))
        self.past = check_choice("planner.past", past, ("previous", "shifted"))
        if backend is None:
            backend = "fast" if hasattr(env, "returns") else "env"
        self.backend = check_choice("planner.backend", backend, ("fast", "env"))
        if self.backend == "fast" and not hasattr(env, "returns"):
            raise ConfigurationError(
                f"planner.backend='fast': {type(env).__name__} has no `returns`; use 'env'"
            )
        self.mean_key = as_key(mean_key)
        self.seed_key = None if seed_key is None else as_key(seed_key)
        self.action_key = as_key(action_key)
        mean_key = self.mean_key if isinstance(self.mean_key, tuple) else (self.mean_key,)
        self.next_mean_key = ("next", *mean_key)
        self.in_keys = [*env.observation_spec.keys(True, True), self.mean_key]
        if self.seed_key is not None:
            self.in_keys.append(self.seed_key)
        self.out_keys = [self.action_key, self.next_mean_key]
        self.streams = Streams(salt=1, seed=seed)
        self.discarded = 0
        space = self.action_spec.space
        half = (space.high - space.low) / 2
        self.register_buffer("scale", sigma * half if noise == "scaled" else torch.ones_like(half))
        self._told = False

    def make_tensordict_primer(self) -> ZeroPrimer:
        """Return the transform that puts a zero mean plan into every reset."""
        shape = (self.horizon, *self.action_spec.shape)
        spec = Composite({self.mean_key: Unbounded(shape, dtype=self.action_spec.dtype)})
        return ZeroPrimer(spec)

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs,
    ) -> TensorDictBase:
        """Write the action and the next mean plan."""
        mean = self._plan(tensordict)
        action = self.action_spec.project(mean[..., 0, :])
        out = tensordict if tensordict_out is None else tensordict_out
        return out.set(self.action_key, action).set(self.next_mean_key, mean)

    def planning(self, td: TensorDictBase) -> Tensor:
        """Return the action ``(*B, A)`` without writing anything."""
        return self._plan(td)[..., 0, :]

    @torch.no_grad()
    def _plan(self, td: TensorDictBase) -> Tensor:
        """Return the new mean plan ``(*B, H, A)``."""
        mean = self._mean(td)
        shifted = torch.cat([mean[..., 1:, :], mean[..., -1:, :]], -2)
        past = (mean if self.past == "previous" else shifted)[..., 0, :]
        space = self.action_spec.space
        best = shifted
        for _ in range(self.iterations):
            eps = self._noise(td, mean)
            raw = best.unsqueeze(-3) + self.scale * eps
            plans = smooth(raw, past.unsqueeze(-2), self.beta, space.low, space.high)
            best = self._blend(self._returns(td, plans), plans, best)
        return best

    def _mean(self, td: TensorDictBase) -> Tensor:
        mean = td.get(self.mean_key, None)
        if mean is not None:
            return mean
        if not self._told:
            warnings.warn(
                f"planner: no {self.mean_key} in the tensordict, so every plan starts cold; "
                "append planner.make_tensordict_primer() to the environment",
                stacklevel=4,
            )
            self._told = True
        shape = (*td.batch_size, self.horizon, *self.action_spec.shape)
        return torch.zeros(shape, device=td.device, dtype=self.action_spec.dtype)

    def _noise(self, td: TensorDictBase, like: Tensor) -> Tensor:
        return self.streams.normal(
            (self.population, *like.shape[-2:]),
            batch=like.shape[:-2],
            seeds=None if self.seed_key is None else td.get(self.seed_key),
            bound=BOUND,
            device=like.device,
            dtype=like.dtype,
        )

    def _returns(self, td: TensorDictBase, plans: Tensor) -> Tensor:
        """Return the return ``(*B, N)`` of each plan ``(*B, N, H, A)``."""
        if self.backend == "fast":
            task = [td.get(key) for key in self.env.cost.in_keys]
            return self.env.returns(td.get(self.env.observation_key), plans, *task)
        batch = plans.shape[:-2]
        start = td.select(*self.env.observation_spec.keys(True, True), strict=False)
        start = start.unsqueeze(-1).expand(batch).clone()
        steps = iter(plans.unbind(-2))
        rollout = self.env.rollout(
            self.horizon,
            policy=lambda now: now.set(self.action_key, next(steps)),
            auto_reset=False,
            tensordict=start,
            break_when_any_done=False,
            trust_policy=True,  # it takes the tensordict itself
        )
        rewards = _mask_post_done_reward(rollout, done_key=_planning_done_keys(self.env))
        return rewards.sum((-2, -1))

    def _blend(self, returns: Tensor, plans: Tensor, fallback: Tensor) -> Tensor:
        """Return the weighted mean plan, or ``fallback`` where no return is finite."""
        weights = path_weights(returns, self.temperature)
        mean = (weights.unsqueeze(-2) @ plans.flatten(-2)).squeeze(-2).view_as(fallback)
        finite = returns.isfinite()
        if bool(finite.all()):
            return mean
        self.discarded += int((~finite).sum())
        lost = ~finite.any(-1)
        if bool(lost.any()):
            warnings.warn(
                f"planner: no finite return for {int(lost.sum())} of {lost.numel()} plans; "
                "the previous plan stands",
                stacklevel=4,
            )
        return torch.where(lost[..., None, None], fallback, mean)
