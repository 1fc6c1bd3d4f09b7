"""What a planner minimises."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.spaces.keys import as_keys


class Cost(nn.Module, ABC):
    """Cost of one imagined step, given what the environment says of the task.

    Attributes:
        in_keys: tensordict entries that describe the task, such as the goal.
        in_sizes: their sizes.
    """

    in_keys: list[NestedKey]
    in_sizes: list[int]

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the cost ``(*B)`` of a step to ``next_state`` ``(*B, S)``.

        ``task`` holds the entries of ``in_keys``, each ``(*B, size)`` or broadcastable.
        """


class GoalDistance(Cost):
    r"""Distance to a goal: :math:`\|W (s_{t+1} - g)\|_2` over chosen coordinates.

    The goal gives the first coordinates; a coordinate without a goal is driven to zero. So
    coordinates ``[0, 1]`` with a goal (x, y) are ``goal_position``, and ``[0, 1, 2]`` with
    the same goal are the paper's ``goal_pose``, which asks for heading 0 everywhere.

    Args:
        coordinates: indices of the state coordinates that count.
        in_keys: the goal's key.
        goal_size: number of goal coordinates.
        weights: weight of each coordinate (1 each), in cost units per m or rad.

    >>> cost = GoalDistance([0, 1])
    >>> here = torch.zeros(3)
    >>> cost(here, torch.zeros(2), here, torch.tensor([3.0, 4.0]))
    tensor(5.)
    """

    weights: Tensor

    def __init__(
        self,
        coordinates: Sequence[int] = (0, 1),
        in_keys: Sequence[NestedKey] = ("goal",),
        goal_size: int = 2,
        weights: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.coordinates = list(coordinates)
        self.in_keys = as_keys(in_keys)
        self.in_sizes = [check_count("cost.goal_size", goal_size)]
        if goal_size > len(self.coordinates):
            raise ConfigurationError(
                f"cost.coordinates={self.coordinates}: expected at least one per goal "
                f"coordinate ({goal_size})"
            )
        weights = [1.0] * len(self.coordinates) if weights is None else list(weights)
        if len(weights) != len(self.coordinates):
            raise ConfigurationError(
                f"cost.weights={weights}: expected {len(self.coordinates)} numbers"
            )
        checked = [check_number("cost.weights", weight, low=0.0) for weight in weights]
        self.register_buffer("weights", torch.tensor(checked), persistent=False)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the weighted distance ``(*B)``."""
        (goal,) = task
        total: Tensor | float = 0.0
        for k, coordinate in enumerate(self.coordinates):  # a handful: cheaper than gathering
            gap = next_state[..., coordinate]
            if k < goal.shape[-1]:
                gap = gap - goal[..., k]
            total = total + (self.weights[k] * gap).square()
        return torch.as_tensor(total).sqrt()


def check_arguments(name: str, function: Callable[..., Any], count: int) -> None:
    """Check that a function takes ``count`` arguments, as far as it says so.

    Raises:
        ConfigurationError: otherwise.

    >>> check_arguments("cost.reward", lambda state, action, next_state: 0.0, 3)
    """
    try:
        expected = inspect.signature(function)
    except (TypeError, ValueError):  # of functions in C nothing is known
        return
    try:
        expected.bind(*[None] * count)
    except TypeError as error:
        raise ConfigurationError(
            f"{name}{expected}: expected a function of {count} arguments: state, action, next "
            f"state, and an entry of the task for each of in_keys; {error}"
        ) from error


class KnownReward(Cost):
    """The reward of somebody else's task, written down: the cost is its negative.

    Args:
        reward: ``reward(state, action, next_state, *task) -> reward``, batched.
        in_keys: tensordict entries that describe the task, if it has any.
        in_sizes: their sizes.

    >>> upright = KnownReward(lambda state, action, next_state: -state[..., 0].square())
    >>> upright(torch.tensor([3.0, 0.0]), torch.zeros(1), torch.zeros(2))
    tensor(9.)
    """

    def __init__(
        self,
        reward: Callable[..., Tensor],
        in_keys: Sequence[NestedKey] = (),
        in_sizes: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.reward = reward
        self.in_keys, self.in_sizes = as_keys(in_keys), list(in_sizes)
        if len(self.in_keys) != len(self.in_sizes):
            raise ConfigurationError(
                f"in_sizes={self.in_sizes}: expected one for each of in_keys={self.in_keys}"
            )
        check_arguments("cost.reward", reward, 3 + len(self.in_keys))

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the negative reward ``(*B)``."""
        return -self.reward(state, action, next_state, *task)
