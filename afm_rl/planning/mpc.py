"""Model predictive control by Gauss-Newton steps on a linearised model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, cast

import torch
from annotated_types import Le
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_indices
from afm_rl.options import Count, options
from afm_rl.planning.costs import TrackingCost
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.planning.receding import ActionKey, RecedingHorizonPlanner
from afm_rl.planning.riccati import LQProblem, solve_lq

FIRST_ITERATIONS = 5  # linearisations at the first tick of a flight


def linear_quadratic(
    world: PlanningEnv,
    states: Tensor,
    actions: Tensor,
    task: Sequence[Tensor],
    low: Tensor,
    high: Tensor,
) -> LQProblem:
    """Return the problem of the best small change of a trajectory (multiple shooting).

    Around states x ``(*B, N + 1, S)`` and actions u ``(*B, N, A)`` the dynamics are
    :math:`dx_{k+1} = A_k dx_k + B_k du_k + f(x_k, u_k) - x_{k+1}`, as the trajectory need not
    follow them; the cost is expanded to second order. :math:`dx_0 = 0`.
    """
    ahead, by_state, by_action = world.dynamics.linearise(states[..., :-1, :], actions)
    gap = world.dynamics.manifold.subtract(ahead, states[..., 1:, :])
    cost = cast(TrackingCost, world.cost)
    in_states, state_slope, in_actions, action_slope = cost.quadratic(states, actions, *task)
    return LQProblem(
        *(by_state, by_action, gap, in_states, state_slope, in_actions, action_slope),
        start=torch.zeros_like(states[..., 0, :]),
        low=low - actions,
        high=high - actions,
    )


class MPC(RecedingHorizonPlanner):
    r"""Nonlinear model predictive control, one linear-quadratic problem per tick.

    Minimises the cost of the N + 1 states and N actions from the measured state on, subject
    to the dynamics and to bounds on the actions: the real-time iteration (Diehl et al. 2005).
    Each tick shifts the previous solution by one stage, puts the measured state in front,
    linearises the dynamics along it (:meth:`DynamicsModel.linearise`), solves
    :func:`linear_quadratic` with the bounds, takes the full step and applies the first
    action. Further ``iterations`` repeat this and converge to a stationary point of the
    nonlinear problem, usually linearly, as curvature of the dynamics is left out.

    States and actions of the solution live in the tensordict, so every flight of a batch has
    its own, and resets clear them: append :meth:`make_tensordict_primer` to the
    environment. A flight whose memory is zero is new: it starts from a constant state
    and the middle of the action bounds, with five iterations.

    Args:
        env: a :class:`PlanningEnv` whose cost is a :class:`TrackingCost`.

    The cost's task entries may be ``(*B, size)``, held over the horizon, or ``(*B, N + 1,
    size)``, one per stage. Solutions that are not finite are counted in :attr:`discarded`;
    the previous plan, shifted, is kept with a warning. :attr:`inexact` counts those
    within the bounds that are not the minimum, see :func:`solve_lq`.

    Raises:
        ConfigurationError: for settings that cannot be used, or task entries of other shapes.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import PlanningEnv, TrackingCost
    >>> cost = TrackingCost([1.0, 1.0, 0.0], [0.01, 0.01], coordinates=[0, 1])
    >>> planner = MPC(PlanningEnv(Dubins(), cost, [-1.0, -1.5], [1.0, 1.5]), horizon=5)
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "reference": torch.ones(4, 2)}, [4])
    >>> memory = {"states": torch.zeros(4, 6, 3), "actions": torch.zeros(4, 5, 2)}
    >>> planner(td.set("mpc", TensorDict(memory, [4])))["action"].shape
    torch.Size([4, 2])
    """

    low: Tensor
    high: Tensor

    @options("planner")
    def __init__(
        self,
        env: PlanningEnv,
        horizon: Annotated[Count, Le(10_000), "stages, N"] = 20,
        iterations: Annotated[Count, Le(10_000), "linearisations per tick"] = 1,
        bounded: Annotated[
            Sequence[int] | None, "actions that the plan limits to their bounds; None: all"
        ] = None,
        action_key: ActionKey = "action",
    ) -> None:
        if not isinstance(env, PlanningEnv) or not isinstance(env.cost, TrackingCost):
            cost = f" with {type(env.cost).__name__}" if isinstance(env, PlanningEnv) else ""
            raise ConfigurationError(
                f"planner: got {type(env).__name__}{cost}; MPC needs a PlanningEnv with a "
                "TrackingCost"
            )
        size = env.dynamics.action_size
        memory: dict[NestedKey, tuple[int, ...]] = {
            ("mpc", "states"): (horizon + 1, env.dynamics.state_size),
            ("mpc", "actions"): (horizon, size),
        }
        super().__init__(env, memory, action_key)
        self.horizon, self.stages, self.iterations = horizon, horizon + 1, iterations
        space = self.action_spec.space
        within = range(size) if bounded is None else bounded
        free = torch.ones(size, dtype=torch.bool)
        free[check_indices("planner.bounded", within, size)] = False
        self.register_buffer("low", space.low.masked_fill(free, -torch.inf), persistent=False)
        self.register_buffer("high", space.high.masked_fill(free, torch.inf), persistent=False)
        self.register_buffer("middle", (space.low + space.high) / 2, persistent=False)
        self.in_keys = [env.observation_key, *env.cost.in_keys, *self.memory]
        self.inexact = 0
        states, actions = (torch.zeros(shape) for shape in self.memory.values())
        task = [torch.zeros(1, size) for size in env.cost.in_sizes]
        env.cost.quadratic(states, actions, *task)  # it says what does not fit

    @torch.no_grad()
    def plan(self, td: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """Return the action, and states ``(*B, N + 1, S)`` and actions ``(*B, N, A)``."""
        measured, *entries = self.env.entries(td)
        task = self._task(td.batch_size, entries)
        shifted = [torch.cat([old[..., 1:, :], old[..., -1:, :]], -2) for old in self._recall(td)]
        states, actions = (old.to(measured) for old in shifted)
        new = (states == 0).flatten(-2).all(-1) & (actions == 0).flatten(-2).all(-1)
        alike = new[..., None, None]
        here = measured.unsqueeze(-2)
        # The last state may stay as it is: the solution does not depend on it.
        guess = [
            torch.cat([here, torch.where(alike, here, states[..., 1:, :])], -2),
            torch.where(alike, self.middle.to(actions), actions),
        ]
        solved, rounds = torch.zeros_like(new), self.iterations
        if bool(new.any()):
            rounds = max(rounds, FIRST_ITERATIONS)
        for count in range(rounds):
            better, exact = self._improve(guess, task)
            sound = better[0].flatten(-2).isfinite().all(-1)
            sound = sound & better[1].flatten(-2).isfinite().all(-1)
            wanted = torch.where(new, count < FIRST_ITERATIONS, count < self.iterations)
            use = sound & wanted
            guess = _choose(use, better, guess)
            solved = solved | use
            self.inexact += int((use & ~exact).sum())
        self._discard(solved.unsqueeze(-1), "solution")
        dtype = self.action_spec.dtype
        solution = _choose(solved, [found.to(dtype) for found in guess], shifted)
        return solution[1][..., 0, :], solution

    def _improve(
        self, guess: Sequence[Tensor], task: Sequence[Tensor]
    ) -> tuple[list[Tensor], Tensor]:
        """Return states and actions after one Gauss-Newton step, and whether it is exact."""
        states, actions = guess
        low, high = self.low.to(actions), self.high.to(actions)
        found = solve_lq(linear_quadratic(self.env, states, actions, task, low, high))
        actions = torch.minimum(torch.maximum(actions + found.controls, low), high)  # rounding
        return [states + found.states, actions], found.exact

    def _task(self, batch: torch.Size, entries: Sequence[Tensor]) -> list[Tensor]:
        """Return the cost's entries, ``(*B, N + 1, size)`` or ``(*B, 1, size)``; refuse others."""
        cost, task = self.env.cost, []
        for key, size, entry in zip(cost.in_keys, cost.in_sizes, entries, strict=True):
            held, staged = (*batch, size), (*batch, self.horizon + 1, size)
            if entry.shape not in (held, staged):
                raise ConfigurationError(
                    f"planner: {key!r} has shape {tuple(entry.shape)}; expected {held}, held over "
                    f"the horizon, or {staged}, one per stage"
                )
            task.append(entry.unsqueeze(-2) if entry.shape == held else entry)
        return task


def _choose(where: Tensor, first: Sequence[Tensor], second: Sequence[Tensor]) -> list[Tensor]:
    """Take each flight's tensors from ``first`` or ``second``; ``where`` is ``(*B)``."""
    if bool(where.all()):
        return list(first)
    mask = where[..., None, None]
    return [torch.where(mask, a, b) for a, b in zip(first, second, strict=True)]
