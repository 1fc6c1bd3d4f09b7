"""Somebody else's task: the few facts by which missions can be run in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel, KnownDynamics, MuJoCoDynamics
from afm_rl.errors import ConfigurationError, NonFiniteError, refusing
from afm_rl.planning.costs import check_arguments
from afm_rl.regimes import Regime

Reward = Callable[..., Tensor]
Contexts = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]
PROBE = 2, 3  # batch in which a reward is tried
NOWHERE = torch.zeros(0)  # the goal of a task without one


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task whose world is a dynamics model.

    Args:
        name: short name.
        world: dynamics of the world, from full states ``(*B, S)`` and effective actions.
        start: returns the first state ``(S,)`` and the goal ``(G,)`` for a seed.
        reward: ``reward(state, action, next_state, *goal) -> reward``, batched.
        low: lowest action, ``(A,)``.
        high: highest action, ``(A,)``.
        dt: time of a step (s).
        steps: length of an episode.
        state_names: of the state coordinates.
        action_names: of the action's components.
        goal_names: of the goal's coordinates; none without a goal.
        plan: the reward for planning; that of the task if None.
        ends: ``ends(next_state) -> bool``, whether an episode ends early; never if None.
        features: state coordinates that the dynamics depend on; all if none.
        observe: function from states ``(*B, S)`` to observations of a policy ``(*B, O)``; the
            states if None.
        reward_in: the reward in a MuJoCo model with other physics, ``reward_in(model)``; the same
            if None.
        goal_in: the goal as the robot's sensors show it there, ``goal_in(model, goal)``.
        contexts: regimes of the phases, the last one for all that follow, by the name of their
            family.
        changes: changes other than those of the actuators, by the name of the family; they act
            after those.

    Raises:
        ConfigurationError: for actions without limits, or a reward that cannot be used.
    """

    name: str
    world: DynamicsModel
    start: Callable[[int], tuple[Tensor, Tensor]]
    reward: Reward
    low: Sequence[float]
    high: Sequence[float]
    dt: float
    steps: int
    state_names: Sequence[str]
    action_names: Sequence[str]
    goal_names: Sequence[str] = ()
    plan: Reward | None = None
    ends: Callable[[Tensor], Tensor] | None = None
    features: Sequence[int] = ()
    observe: Callable[[Tensor], Tensor] | None = None
    reward_in: Callable[[Any], Reward] | None = None
    goal_in: Callable[[Any, Tensor], Tensor] | None = None
    contexts: Contexts = field(default_factory=dict)
    changes: Mapping[str, Regime] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check limits and rewards."""
        bounds = torch.tensor([list(self.low), list(self.high)])
        # Unbounded specs say 1e30 or more.
        endless = (~(bounds.abs() < 1e30).all(0)).nonzero().flatten().tolist()
        if endless:
            names = ", ".join(self.action_names[axis] for axis in endless)
            raise ConfigurationError(
                f"robot: {self.name}: actions {names} have no limits; give robot.action_low and "
                "robot.action_high"
            )
        for reward in (self.reward, self.planned):
            self._check(reward)

    def _check(self, reward: Reward) -> None:
        state, goal = (part.float().expand(*PROBE, -1) for part in self.start(0))
        goals = [goal] if self.goal_names else []
        check_arguments("robot.reward", reward, 3 + len(goals))
        action = torch.zeros(*PROBE, len(self.low))
        shapes = f"states {tuple(state.shape)} and actions {tuple(action.shape)}"
        with refusing(f"robot.reward: fails for {shapes}"):
            value = reward(state, action, state, *goals)
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        if shape != PROBE:
            raise ConfigurationError(
                f"robot.reward: returned {shape} for states {tuple(state.shape)}; expected a "
                f"tensor {PROBE}, one number per state"
            )
        if not bool(value.isfinite().all()):
            raise ConfigurationError(
                f"robot.reward: is {value[0, 0]:g} in the first state, {state[0, 0].tolist()}, for "
                "an action of zeros; expected a finite number"
            )

    @property
    def planned(self) -> Reward:
        """The reward for planning."""
        return self.reward if self.plan is None else self.plan

    def begin(
        self, seeds: Tensor, rows: Tensor | None = None, physics: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return ``pose`` ``(*B, S)`` and, if there is one, ``goal`` ``(*B, G)``, by seed.

        Rows for which ``rows`` ``(*B)`` is false are not used.
        """
        needed = seeds if rows is None else torch.where(rows, seeds, 0)
        known = {seed: self.start(seed) for seed in set(needed.flatten().tolist())}
        states, goals = zip(*(known[seed] for seed in needed.flatten().tolist()), strict=True)
        entries = {"pose": torch.stack(states)}
        if self.goal_names:
            entries["goal"] = torch.stack(goals)
            if self.goal_in is not None and physics is not None:
                models = self._models(physics.reshape(-1, physics.shape[-1]))
                pairs = zip(models, goals, strict=True)
                entries["goal"] = torch.stack([self.goal_in(model, goal) for model, goal in pairs])
        return {name: value.reshape(*seeds.shape, -1) for name, value in entries.items()}

    def step(
        self, data: Any, action: Tensor, physics: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return next state, reward ``(*B)`` and whether the episode ends ``(*B)``.

        Args:
            data: the state.
            action: effective action, ``(*B, A)``.
            physics: see :class:`~afm_rl.regimes.Physics`, ``(*B, P)``; for MuJoCo worlds.
        """
        state = data["pose"]
        if physics is not None and isinstance(self.world, MuJoCoDynamics):
            self.world.set_physics(physics)
        ahead = self.world(state, action)
        goal = [data["goal"]] if self.goal_names else []
        reward = self._rewards(physics, state, action, ahead, *goal)
        lost = ~ahead.isfinite().all(-1)
        ended = lost if self.ends is None else lost | self.ends(ahead)
        self._check_finite(torch.where(lost, 0.0, reward), ahead)
        return ahead, torch.where(lost, 0.0, reward), ended

    def _check_finite(self, reward: Tensor, ahead: Tensor) -> None:
        """Refuse a reward that would be the best of all where others are negative."""
        if not bool(reward.isfinite().all()):
            first = int((~reward.isfinite()).flatten().nonzero()[0])
            where = ahead.reshape(-1, ahead.shape[-1])[first].tolist()
            raise NonFiniteError(
                f"{self.name}: the reward is {reward.flatten()[first].item():g} in the state "
                f"{where}; expected a finite number: fix robot.reward, or the environment"
            )

    def _models(self, physics: Tensor) -> list[Any]:
        """Return the MuJoCo model of each row ``(N, P)``."""
        world: Any = self.world
        return world.step.models(physics.cpu().double().numpy())

    def _rewards(self, physics: Tensor | None, *given: Tensor) -> Tensor:
        """Return the rewards ``(*B)`` in the worlds that there are."""
        if physics is None or self.reward_in is None:
            return self.reward(*given)
        batch = given[0].shape[:-1]
        kinds, which = physics.expand(*batch, -1).flatten(0, -2).unique(dim=0, return_inverse=True)
        flat = [part.reshape(-1, part.shape[-1]) for part in given]
        rewards = flat[0].new_zeros(len(which))
        for kind, model in enumerate(self._models(kinds)):
            rows = which == kind
            rewards[rows] = self.reward_in(model)(*(part[rows] for part in flat))
        return rewards.reshape(batch)

    def history(self) -> dict[str, Any]:
        """Return the history that leads to the state of a world with hidden state: empty."""
        return {}

    def replay(self, history: Mapping[str, Any]) -> None:
        """Bring such a world into the state after a history."""


def bound_noise(
    world: KnownDynamics,
    state: Tensor,
    low: Sequence[float],
    high: Sequence[float],
    share: float = 0.1,
) -> KnownDynamics:
    """Bound a model's noise, in place, by a share of what the largest actions effect in a step.

    Short steps have small effects; a change of what they are would be lost in the noise of long
    ones.
    """
    half = (torch.tensor([list(high), list(low)]).diff(dim=0)[0] / 2).abs().nan_to_num(posinf=1.0)
    slopes = world.jacobian(state.float(), torch.zeros(len(half))).abs()
    effect = share * (slopes * half).sum(-1)
    world.noise = torch.where(effect > 0, torch.minimum(world.noise, effect), world.noise)
    return world
