"""Commands by radio, each of which is under way for a time of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper

from afm_rl.comparison.robot import Robot

SHARES = [0.3082, 0.5927, 0.0829, 0.0075, 0.0031, 0.0056]  # of packets that take 1, 2, ... steps


class Radio(VectorWrapper):
    """Environments whose commands go by WiFi, as measured for DCAC (Bouteiller et al. 2021).

    A command acts after a step and two draws, one of its own and one of the observation that it
    answers: the newest that has arrived does.
    """

    def reset(self, *, seed: Any = None, options: Any = None):
        """Begin with nothing on its way, and with random numbers of each seed."""
        self.draws = [np.random.default_rng(each) for each in seed]
        self.acting, self.sent, self.due = np.zeros(self.action_space.shape), [], []
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any):
        """Send commands, and make a step with the newest that are there."""
        packets = [1 + draws.choice(6, 2, p=SHARES) for draws in self.draws]
        self.sent.append(actions)
        self.due.append(len(self.sent) + np.sum(packets, -1))
        for command, due in zip(self.sent[-14:], self.due[-14:], strict=True):
            there = due <= len(self.sent) - 1
            self.acting = np.where(there[:, None], command, self.acting)
        return self.env.step(self.acting.astype(self.action_space.dtype))


class WiFi(Robot):
    """A robot that is commanded by radio."""

    def vector(self, count: int) -> Radio:
        """Return so many environments."""
        return Radio(super().vector(count))
