"""The improved cross-entropy method."""

from __future__ import annotations

import math
from typing import Annotated, Unpack

import torch
from annotated_types import Le
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, NonNegative, Positive, options
from afm_rl.planning.receding import (
    Horizon,
    Iterations,
    SamplingOptions,
    SamplingPlanner,
    action_spec_of,
    moments,
)

DECAY = 1.25  # gamma, by which the population shrinks
MOMENTUM = 0.1  # alpha, weight of the old mean and deviation


def coloured(noise: Tensor, beta: float) -> Tensor:
    r"""Colour white noise ``(*B, H, A)`` in time: spectrum :math:`\propto f^{-\beta}`, variance 1.

    0 leaves it white, 1 is pink, 2 red; large ones are all but constant. The lowest frequency, 1/H,
    stands in for frequency 0.

    >>> white = torch.randn(1000, 5, 2)
    >>> torch.allclose(coloured(white, 0.0), white, atol=1e-5)
    True
    >>> red = coloured(white, 3.0)
    >>> bool(red.diff(dim=1).std() < 0.8 * white.diff(dim=1).std())
    True
    """
    steps = noise.shape[-2]
    step = torch.arange(steps, device=noise.device, dtype=noise.dtype)
    frequency = torch.minimum(step, steps - step) / steps
    size = frequency.clamp_min(1 / steps) ** (-beta / 2)
    size = size / size.square().mean().sqrt()
    # Fourier, size and back are one matrix, and a product is faster for the few steps of a plan.
    phase = 2 * math.pi / steps * step * (step[:, None, None] - step[:, None])
    return (size * phase.cos()).mean(-1) @ noise


class ICEM(SamplingPlanner):
    r"""Improved cross-entropy method (iCEM): coloured noise, elites are kept.

    Each step shifts the mean plan :math:`\mu` by one and starts with the standard deviation
    :math:`\sigma_0`. Iteration i draws

    .. math:: N_i = \max(N \gamma^{-i}, 2K),\qquad
              u = \mathrm{clamp}(\mu + \sigma \odot C_\beta(\epsilon)),

    replaces some candidates by the best plans of the previous iteration (or of the previous step,
    shifted), in the last iteration also by the mean, and moves :math:`\mu, \sigma` to those
    of the best K with momentum :math:`\alpha` (Pinneri et al. 2020, "Sample-efficient
    Cross-Entropy Method for Real-time Planning"). The action is the first one of the best
    candidate; under ``ExplorationType.DETERMINISTIC``, ``MEAN``, ``MODE`` and ``MEDIAN`` it is
    the mean's.

    Mean and elites live in the tensordict, so every mission of a batch has its own, and resets
    clear them: append :meth:`make_tensordict_primer` to the environment. A mission whose
    memory is zero is new: it starts from the middle of the action bounds, without elites. It holds
    ``mean`` ``(*B, H, A)`` and ``elites`` ``(*B, k, H, A)``; if an action is held for several
    steps, also ``held`` ``(*B, A + 1)``, the action and its remaining steps.

    Args:
        env: batch-unlocked environment to plan in; a :class:`PlanningEnv` is fastest.

    >>> from tensordict import TensorDict
    >>> from torchrl.envs import TransformedEnv
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> world = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> planner = ICEM(world, horizon=5, candidates=32, elites=8)
    >>> env = TransformedEnv(world, planner.make_tensordict_primer())
    >>> env.rollout(3, planner)["action"].shape
    torch.Size([3, 2])
    """

    @options("planner")
    def __init__(
        self,
        env: EnvBase,
        horizon: Horizon = 5,
        candidates: Annotated[
            Count, "candidates of the first iteration, N, at least twice the elites"
        ] = 100,
        iterations: Iterations = 3,
        elites: Annotated[Count, "best plans, which give mean and standard deviation, K"] = 10,
        keep: Annotated[Positive, Le(1), "share of elites kept for the next iteration"] = 0.3,
        sigma: Annotated[
            NonNegative, Le(100), "initial standard deviation, half ranges of each action"
        ] = 0.5,
        beta: Annotated[NonNegative, Le(100), "exponent of the spectrum; 0: white, 2: red"] = 1.0,
        **settings: Unpack[SamplingOptions],
    ) -> None:
        kept = max(1, round(keep * elites))
        size = len(action_spec_of(env).space.low)
        plan = (horizon, size)
        memory: dict[NestedKey, tuple[int, ...]] = {
            ("icem", "mean"): plan,
            ("icem", "elites"): (kept, *plan),
        }
        if settings.get("hold", 1) != 1:
            memory["icem", "held"] = (size + 1,)
        super().__init__(env, memory, horizon, candidates, iterations, **settings)
        if candidates < 2 * elites:
            raise ConfigurationError(
                f"planner.elites={elites}: expected at most half of planner.candidates={candidates}"
            )
        self.elites, self.kept, self.sigma, self.beta = elites, kept, sigma, beta
        space = self.action_spec.space
        self.register_buffer("scale", self.sigma * (space.high - space.low) / 2)

    @property
    def counts(self) -> list[int]:
        """Candidates of each iteration.

        >>> from afm_rl.dynamics import Dubins
        >>> from afm_rl.planning import GoalDistance, PlanningEnv
        >>> ICEM(PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])).counts
        [100, 80, 64]
        """
        sizes = (self.candidates * DECAY**-i for i in range(self.iterations))
        return [max(round(size), 2 * self.elites) for size in sizes]

    def plan(self, td: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """Return the action and the entries to keep; unchanged while an action is held."""
        memory = self._recall(td)
        if self.hold == 1:
            return self._search(td, *memory)
        *plans, held = memory
        action, left = held[..., :-1], held[..., -1:]
        due = left < 1
        if bool(due.any()):
            new, found = self._search(td, *plans)
            action, left = torch.where(due, new, action), torch.where(due, self.hold, left)
            plans = [
                torch.where(due.reshape(*due.shape, *[1] * (old.dim() - due.dim())), now, old)
                for now, old in zip(found, plans, strict=True)
            ]
        return action, [*plans, torch.cat([action, left - 1], -1)]

    @torch.no_grad()
    def _search(
        self, td: TensorDictBase, mean: Tensor, elites: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the action, the mean plan and the elites that are kept."""
        mean, elites = (torch.cat([x[..., 1:, :], x[..., -1:, :]], -2) for x in (mean, elites))
        new = (elites == 0).flatten(-3).all(-1) & (mean == 0).flatten(-2).all(-1)
        low, high, scale = self._bounds(td)
        mean = torch.where(new[..., None, None], (low + high) / 2, mean)
        std = scale.expand_as(mean)
        best, found = mean, ~new  # which missions have elites
        for i, count in enumerate(self.counts):
            noise = coloured(self._noise(td, mean, count), self.beta)
            plans = mean.unsqueeze(-3) + std.unsqueeze(-3) * noise
            plans[..., : self.kept, :, :] = torch.where(
                found[..., None, None, None], elites, plans[..., : self.kept, :, :]
            )
            if i == self.iterations - 1:
                plans[..., self.kept, :, :] = mean
            plans = torch.minimum(torch.maximum(plans, low.unsqueeze(-2)), high.unsqueeze(-2))
            chosen, returns = self._best(td, plans, self.elites)
            finite = returns.isfinite()
            sound = finite.any(-1)
            here = sound[..., None, None]
            centre, spread = moments(chosen, finite.to(plans))
            best = torch.where(here, chosen[..., 0, :, :], best)
            mean = torch.where(here, torch.lerp(centre, mean, MOMENTUM), mean)
            std = torch.where(here, torch.lerp(spread, std, MOMENTUM), std)
            few = torch.where(finite[..., None, None], chosen, best.unsqueeze(-3))
            few = few[..., : self.kept, :, :]
            elites, found = torch.where(here.unsqueeze(-3), few, elites), found | sound
        plan = best if exploration_type() in (None, ExplorationType.RANDOM) else mean
        return plan[..., 0, :], [mean, elites]
