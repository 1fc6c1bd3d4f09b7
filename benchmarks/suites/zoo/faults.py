"""What happens to the actuators, and a vector of environments to which it happens."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import Tensor

from afm_rl.regimes import Compose, actuator_regimes

FAMILIES = ("delay", "lag", "permutation", "gain", "dead", "bias")


def regime_of(low: np.ndarray, high: np.ndarray) -> Compose:
    """Return the faults that actuators between ``low`` and ``high`` ``(A,)`` can have."""
    families = actuator_regimes(low.tolist(), high.tolist())
    return Compose({name: families[name] for name in FAMILIES})


def faults_of(actuators: int) -> dict[str, dict[str, float]]:
    """Return the faults by name, as parameters of :func:`regime_of`."""
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
        "lag 2": {"lag": 2.0},
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
        rows: what happens in each, ``(N, F)``.
        at: step from which it does.
    """

    def __init__(self, env: VectorEnv, regime: Compose, rows: Tensor, at: int) -> None:
        super().__init__(env)
        self.regime, self.rows, self.at = regime, rows.double(), at

    def reset(self, **options: Any):
        """Begin with actuators that are healthy and were not used yet."""
        self.count = 0
        shape = self.num_envs, self.regime.history, *self.single_action_space.shape
        self.past = torch.zeros(shape, dtype=torch.float64)
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
        return self.env.step(effect.numpy().astype(self.single_action_space.dtype))
