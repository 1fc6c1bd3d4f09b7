"""What happens to the actuators, and a vector of environments to which it happens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper

from afm_rl.regimes import Compose, actuator_regimes

FAMILIES = ("delay", "lag", "permutation", "gain", "dead", "bias")
SLOW = ("lag 1", "lag 3", "rate .3", "rate .2")
"""Faults that are played only if they are asked for."""


def regime_of(low: np.ndarray, high: np.ndarray) -> Compose:
    """Return the faults that actuators between ``low`` and ``high`` ``(A,)`` can have."""
    families = actuator_regimes(low.tolist(), high.tolist())
    return Compose({name: families[name] for name in FAMILIES})


def faults_of(actuators: int) -> dict[str, dict[str, float]]:
    """Return the faults by name: parameters of :func:`regime_of`, and of a limited ``rate``.

    That is by how much effects change in a step at most, in half ranges.
    """
    every, other = range(actuators), actuators // 2
    reversed_ = {f"gain_{k}": -1.0 for k in every}
    found: dict[str, dict[str, float]] = {
        "none": {},
        "one reversed": {"gain_0": -1.0},
        "all reversed": reversed_,
        "swapped pair": {"from_0": other, f"from_{other}": 0},
        "half": {f"gain_{k}": 0.5 for k in every},
        "dead": {"loss_0": 1.0},
        "bias .3": {f"bias_{k}": 0.3 for k in every},
        **{f"late {steps}": {"delay": steps} for steps in (1, 2, 4, 8)},
        **{f"lag {steps}": {"lag": float(steps)} for steps in (1, 2, 3)},
        **{f"rate .{tenths}": {"rate": tenths / 10} for tenths in (3, 2)},
        "reversed and late 2": {**reversed_, "delay": 2},
    }
    if actuators == 1:
        del found["swapped pair"]
    return found


class FaultyVector(VectorWrapper):
    """Environments whose actuators fail ``at`` a step of the first episode.

    Args:
        env: of N environments.
        regime: what can happen.
        faults: what happens in each, N of :func:`faults_of`.
        at: step from which it does.
    """

    def __init__(
        self, env: VectorEnv, regime: Compose, faults: Sequence[dict[str, float]], at: int
    ) -> None:
        super().__init__(env)
        self.regime, self.at = regime, at
        rest = [{name: fault[name] for name in fault if name != "rate"} for fault in faults]
        self.rows = torch.stack([regime.encode(fault) for fault in rest]).double()
        space, rate = env.single_action_space, [[fault.get("rate", np.inf)] for fault in faults]
        self.rate = 0.5 * (space.high - space.low) * np.array(rate)

    def reset(self, **options: Any):
        """Begin with actuators that are healthy and were not used yet."""
        self.count = 0
        shape = self.num_envs, self.regime.history, *self.single_action_space.shape
        self.past, self.reached = torch.zeros(shape, dtype=torch.float64), None
        return self.env.reset(**options)

    @property
    def failed(self) -> bool:
        """Do the actuators have their faults by now?"""
        return self.count >= self.at

    def step(self, actions: Any):
        """Send the actuators what they make of ``actions`` ``(N, A)``."""
        actions = torch.as_tensor(np.asarray(actions)).double()
        effect = actions
        if self.failed:
            state = actions.new_zeros(len(actions), 1)
            effect = self.regime.apply(actions, self.rows, state, self.past)
        self.past = torch.cat([actions.unsqueeze(1), self.past[:, :-1]], 1)
        self.count += 1
        space, effect = self.single_action_space, effect.numpy()
        if self.failed and self.reached is not None:
            effect = np.clip(effect, self.reached - self.rate, self.reached + self.rate)
        self.reached = np.clip(effect, space.low, space.high)
        return self.env.step(effect.astype(space.dtype))
