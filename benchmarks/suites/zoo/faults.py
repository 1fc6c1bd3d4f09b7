"""A vector of environments whose actuators fail under way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import Tensor

from afm_rl.regimes import Actuators
from afm_rl.regimes.presets import Fault

LATER: dict[str, Fault] = {
    "late 3": {"delay": 3},
    "late 12": {"delay": 12},
    "late 25": {"delay": 25},
    "late 0 to 3": {"random_delay": 3},
}
RARE = ("lag 1", "lag 3", "rate .3", "rate .2", *LATER)
"""Faults that are played only if they are asked for."""


class FaultyVector(VectorWrapper):
    """Environments whose actuators fail ``at`` a step of the first episode.

    Args:
        env: of N environments.
        faults: what happens in each, N of those of :class:`~afm_rl.regimes.Actuators`.
        at: step from which it does.
        home: pose of position servos, ``(A,)``, see :class:`~afm_rl.regimes.Actuators`.
    """

    def __init__(
        self, env: VectorEnv, faults: Sequence[Fault], at: int, home: Tensor | None = None
    ) -> None:
        super().__init__(env)
        space: Any = env.single_action_space
        box = space.low.tolist(), space.high.tolist()
        self.actuators = Actuators(*box, [env.num_envs], home)
        self.at = at
        self.faults = faults

    def reset(self, **options: Any):
        """Begin with actuators that were not used yet, healthy if they fail later."""
        self.count = 0
        self.actuators.reset()
        self.actuators.fail(*(self.faults if self.failed else [{}]))
        return self.env.reset(**options)

    @property
    def failed(self) -> bool:
        """Do the actuators have their faults by now?"""
        return self.count >= self.at

    def step(self, actions: Any):
        """Send the actuators what they make of ``actions`` ``(N, A)``."""
        effect = self.actuators(torch.as_tensor(np.asarray(actions))).numpy()
        self.count += 1
        if self.count == self.at:
            self.actuators.fail(*self.faults)
        return self.env.step(effect.astype(self.single_action_space.dtype))
