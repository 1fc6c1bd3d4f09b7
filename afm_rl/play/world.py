"""Two robots with the same policy and the same faults: one without AFM, one with AFM."""

from __future__ import annotations

from collections import deque
from threading import RLock
from typing import Any

import numpy as np

from afm_rl.play.robots import PlayedRobot
from afm_rl.regimes.presets import Fault
from afm_rl.transforms.fault_wrapper import FaultWrapper
from afm_rl.transforms.gymnasium import ActionFlowWrapper

SIDES = ("without AFM", "with AFM")


class Side:
    """One of the two robots."""

    def __init__(self, robot: PlayedRobot, corrected: bool) -> None:
        self.robot = robot
        self.env: Any = FaultWrapper(robot.make(), home=robot.home, clip=False)
        self.faulty: FaultWrapper = self.env
        if corrected:
            model, corrector = robot.model, robot.corrector()
            self.env = ActionFlowWrapper(self.env, **model, corrector=corrector, belief=True)
        self.rewards: deque[float] = deque(maxlen=400)  # drawn as curves
        self.commands: deque[np.ndarray] = deque(maxlen=400)
        self.falls = 0
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin again."""
        self.act = self.robot.policy()
        self.observation, self.info = self.env.reset(seed=seed)
        self.steps, self.lying = 0, 0.0

    def step(self) -> None:
        """Act once; a robot that fell lies for a moment and begins again."""
        if self.lying > 0:
            self.lying -= self.robot.dt
            if self.lying <= 0:
                self.reset(self.falls)
            return
        planned = self.act(self.observation, self.info)
        self.observation, reward, over, _, self.info = self.env.step(planned)
        self.steps += 1
        self.rewards.append(float(reward))
        executed = self.info.get("afm", {}).get("executed_action", planned)
        self.commands.append(np.stack([planned, executed, self.faulty.effect]))
        if over:
            self.falls, self.lying = self.falls + 1, 1.0  # s

    @property
    def inner(self) -> Any:
        """The innermost environment."""
        return self.env.unwrapped


class World:
    """Both robots; hold the ``lock`` to read or change them.

    >>> from afm_rl.play.robots import make_robot
    >>> world = World(make_robot("pendulum"))
    >>> world.fail({"gain_0": -1.0})
    >>> world.step()
    >>> world.sides["with AFM"].steps
    1
    """

    def __init__(self, robot: PlayedRobot) -> None:
        self.robot, self.lock = robot, RLock()
        self.fault: Fault = {}
        self.sides = {name: Side(robot, name == "with AFM") for name in SIDES}
        self.seed, self.direction = 0, 1.0

    def fail(self, fault: Fault) -> None:
        """Give the actuators of both a fault, see :meth:`~afm_rl.FaultWrapper.fail`."""
        with self.lock:
            self.fault = fault
            for side in self.sides.values():
                side.faulty.fail(fault)

    def step(self) -> None:
        """Let both act once."""
        with self.lock:
            for side in self.sides.values():
                side.step()

    def reset(self) -> None:
        """Begin a new episode, the same for both."""
        with self.lock:
            self.seed += 1
            for side in self.sides.values():
                side.reset(self.seed)
                side.falls = 0

    def push(self) -> None:
        """Push both, once from the left and once from the right."""
        with self.lock:
            for side in self.sides.values():
                self.robot.push(side.inner, self.direction)
            self.direction = -self.direction
