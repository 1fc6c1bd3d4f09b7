"""Tasks of gymnasium: what a planner wants there, and what changes half-way."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from afm_rl.planning import ICEM, MPPI


def swing_up(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Reward of Pendulum-v1, ``(*B)``; the state is (cos, sin, speed)."""
    cos, sin, speed = state.unbind(-1)
    angle = torch.atan2(sin, cos)
    return -(angle**2 + 0.1 * speed**2 + 0.001 * action.square().sum(-1))


def balance(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Pole upright, cart in the middle: the reward of InvertedPendulum-v5 is 1 until it falls."""
    return -(next_state[..., 1] ** 2 + 0.05 * next_state[..., 0] ** 2)


def reach(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Reward of Reacher-v5, ``(*B)``; the state ends with fingertip minus target."""
    return -next_state[..., 8:10].norm(dim=-1) - action.square().sum(-1)


def run_forward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Reward of HalfCheetah-v5, with the mean of two speeds for the distance, less somersaults.

    Those pay in the task, but a model that saw few of them ends up on its back with no way out.
    """
    speed, pitch = 0.5 * (state[..., 8] + next_state[..., 8]), next_state[..., 1]
    upset = (pitch.abs() - 0.5).clamp_min(0.0)
    return speed - 0.1 * action.square().sum(-1) - upset


@dataclass(frozen=True)
class Task:
    """A task: an environment, a reward to plan with, budgets, and changes."""

    id: str
    """Of gymnasium."""
    reward: Callable[[Tensor, Tensor, Tensor], Tensor]
    """For the planner; see :class:`~afm_rl.planning.KnownReward`."""
    changes: Mapping[str, Mapping[str, float]]
    """Regimes of the second half, by name: ``gain_i`` and ``bias_i`` of actuator i."""
    steps: int = 200
    """Length of an episode; the change comes in the middle."""
    rounds: Sequence[int] = (2000, 1000)
    """Transitions to learn from: random actions first, then the planner's."""
    fit: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the ensemble's fit."""
    hidden: Sequence[int] = (64, 64)
    """Units of the ensemble's layers."""
    search: type[MPPI] | type[ICEM] = MPPI
    """The planner."""
    planner: Mapping[str, Any] = field(default_factory=dict)
    """Its settings."""


REVERSED = {"gain_0": -1.0}
WEAK = {"gain_0": 0.5, "bias_0": 0.2}
TASKS = {
    "pendulum": Task(
        "Pendulum-v1",
        swing_up,
        {"reversed": REVERSED, "weak, biased": WEAK},
        planner={"horizon": 20, "population": 200, "temperature": 1.0},
    ),
    "inverted_pendulum": Task(
        "InvertedPendulum-v5",
        balance,
        {"reversed": REVERSED, "weak, biased": WEAK},
        rounds=(2000, 1000, 1000),
        planner={"horizon": 15, "population": 200, "temperature": 0.003, "sigma": 0.3},
    ),
    "arm": Task(
        "Reacher-v5",
        reach,
        {
            "both reversed": {"gain_0": -1.0, "gain_1": -1.0},
            "one reversed": {"gain_1": -1.0},
            "weak, biased": {"gain_0": 0.5, "gain_1": 0.5, "bias_0": 0.2, "bias_1": -0.2},
        },
        rounds=(6000, 2000),
        fit={"epochs": 50},
        hidden=(128, 128),
        planner={"horizon": 10, "population": 200, "temperature": 0.1, "sigma": 0.3},
    ),
    "half_cheetah": Task(
        "HalfCheetah-v5",
        run_forward,
        {
            "back thigh reversed": {"gain_0": -1.0},
            "thighs reversed": {"gain_0": -1.0, "gain_3": -1.0},
            "all at half": {f"gain_{axis}": 0.5 for axis in range(6)},
            "back thigh dead": {"gain_0": 0.0},
        },
        rounds=(4000, *[1000] * 9),
        fit={"epochs": 50, "batch_size": 64},
        hidden=(128, 128),
        search=ICEM,
        planner={
            **{"horizon": 20, "population": 150, "iterations": 4, "elites": 15},
            **{"sigma": 1.0, "beta": 2.0},  # wide and slow: a gait is no trembling
        },
    ),
}
