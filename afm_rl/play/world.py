"""Two robots with the same policy and the same faults: one alone, one with AFM."""

from __future__ import annotations

from collections import deque
from threading import RLock
from typing import Any

import gymnasium
import numpy as np
import torch

from afm_rl.play.robots import PlayedRobot
from afm_rl.regimes import Actuators
from afm_rl.regimes.presets import Fault
from afm_rl.transforms.gymnasium import ActionFlowWrapper

SIDES = ("alone", "AFM")


class FaultyEnv(gymnasium.Wrapper):
    """An environment whose actuators can :meth:`fail`.

    Args:
        env: with a vector of real numbers between finite bounds as action.
        home: pose of position servos, whose faults are about it and in the unit of the commands.

    >>> env = FaultyEnv(gymnasium.make("Pendulum-v1"))
    >>> env.fail({"gain_0": -1.0})
    >>> _ = env.reset(seed=0), env.step(np.array([1.5]))
    >>> env.effect
    array([-1.5], dtype=float32)
    """

    def __init__(self, env: gymnasium.Env, home: torch.Tensor | None = None) -> None:
        super().__init__(env)
        space: Any = env.action_space
        self.actuators = Actuators(space.low.tolist(), space.high.tolist(), home=home)
        self.half = (space.high - space.low) / 2 if home is None else 1.0
        self.noise = 0.0
        self.random = np.random.default_rng(0)

    def fail(self, fault: Fault) -> None:
        """Have a fault of :class:`~afm_rl.regimes.Actuators`, or ``noise``, as an offset is."""
        self.noise = fault.get("noise", 0.0)
        self.actuators.fail({name: x for name, x in fault.items() if name != "noise"})

    def reset(self, **options: Any):
        """Begin with actuators that were not used yet."""
        self.actuators.reset()
        return self.env.reset(**options)

    def step(self, action: Any):
        """Send the actuators what they make of the command."""
        effect = self.actuators(torch.as_tensor(np.asarray(action))).numpy()
        noise = self.random.standard_normal(len(effect)) * self.noise
        self.effect = (effect + noise * self.half).astype(self.action_space.dtype)
        return self.env.step(self.effect)


class Side:
    """One of the two robots."""

    def __init__(self, robot: PlayedRobot, corrected: bool) -> None:
        self.robot = robot
        self.env: Any = FaultyEnv(robot.make(), robot.home)
        self.faulty: FaultyEnv = self.env
        if corrected:
            model, corrector = robot.model, robot.corrector()
            self.env = ActionFlowWrapper(self.env, **model, corrector=corrector, belief=True)
        self.rewards: deque[float] = deque(maxlen=400)  # drawn as curves
        self.commands: deque[np.ndarray] = deque(maxlen=400)
        self.falls = 0
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin anew."""
        self.act = self.robot.policy()
        self.observation, self.info = self.env.reset(seed=seed)
        self.steps, self.lying = 0, 0.0

    def step(self) -> None:
        """Act once; a robot that fell lies for a moment and begins anew."""
        if self.lying > 0:
            self.lying -= self.robot.dt
            if self.lying <= 0:
                self.reset(self.falls)
            return
        planned = self.act(self.observation, self.info)
        self.observation, reward, over, _, self.info = self.env.step(planned)
        self.steps += 1
        self.rewards.append(float(reward))
        executed = self.info.get("afm", {}).get("executed", planned)
        self.commands.append(np.stack([planned, executed, self.faulty.effect]))
        if over:
            self.falls, self.lying = self.falls + 1, 1.0  # s

    @property
    def inner(self) -> Any:
        """The innermost environment."""
        return self.env.unwrapped


class World:
    """Both robots; whoever reads or changes them holds the ``lock``.

    >>> from afm_rl.play.robots import make_robot
    >>> world = World(make_robot("pendulum"))
    >>> world.fail({"gain_0": -1.0})
    >>> world.step()
    >>> world.sides["AFM"].steps
    1
    """

    def __init__(self, robot: PlayedRobot) -> None:
        self.robot, self.lock = robot, RLock()
        self.fault: Fault = {}
        self.sides = {name: Side(robot, name == "AFM") for name in SIDES}
        self.seed, self.direction = 0, 1.0

    def fail(self, fault: Fault) -> None:
        """Give the actuators of both a fault, see :meth:`FaultyEnv.fail`."""
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
