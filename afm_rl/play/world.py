"""Two robots with the same policy and the same faults: one alone, one with AFM."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from threading import RLock
from typing import Any

import gymnasium
import numpy as np
import torch

from afm_rl.play.robots import Robot
from afm_rl.regimes import Compose, actuator_regimes
from afm_rl.transforms.gymnasium import ActionFlowWrapper

SIDES = ("alone", "AFM")
KEPT = 400  # steps that are drawn as curves
LYING = 1.0  # seconds that a robot lies where it fell


@dataclass
class Faults:
    """What the actuators of both robots have now; the numbers of a healthy robot are the default.

    Args:
        values: parameters of :func:`~afm_rl.regimes.actuator_regimes`, such as ``gain_0``.
        noise: standard deviation of normal noise on the commands, in half ranges.
    """

    values: dict[str, float] = field(default_factory=dict)
    noise: float = 0.0


def presets(actuators: int) -> dict[str, dict[str, float]]:
    """Return faults by name."""
    every, other = range(actuators), actuators // 2
    found: dict[str, dict[str, float]] = {
        "healthy": {},
        "reverse one": {"gain_0": -1.0},
        "reverse all": {f"gain_{k}": -1.0 for k in every},
        "swap": {"from_0": other, f"from_{other}": 0.0},
        "half strength": {f"gain_{k}": 0.5 for k in every},
        "one dead": {"loss_0": 1.0},
        "bias": {f"bias_{k}": 0.3 for k in every},
        "late by 1": {"delay": 1},
        "late by 4": {"delay": 4},
        "late by 8": {"delay": 8},
        "slow": {"lag": 2.0},
        "reversed and late": {**{f"gain_{k}": -1.0 for k in every}, "delay": 2},
    }
    if actuators == 1:
        del found["swap"], found["reverse all"]
    return found


class Actuators(gymnasium.Wrapper):
    """An environment whose actuators do what ``faults`` says with a command.

    Args:
        env: with a vector of real numbers between finite bounds as action.
        faults: shared with whoever changes them.

    >>> env = Actuators(gymnasium.make("Pendulum-v1"), Faults({"gain_0": -1.0}))
    >>> _ = env.reset(seed=0), env.step(np.array([1.5]))
    >>> env.effect
    array([-1.5], dtype=float32)
    """

    def __init__(self, env: gymnasium.Env, faults: Faults) -> None:
        super().__init__(env)
        space: Any = env.action_space
        families = actuator_regimes(space.low.tolist(), space.high.tolist())
        chosen = ("delay", "lag", "permutation", "gain", "dead", "bias")
        self.regime = Compose({name: families[name] for name in chosen})
        self.faults, self.random = faults, np.random.default_rng(0)
        self.half = (space.high - space.low) / 2

    def reset(self, **options: Any):
        """Begin with actuators that were not used yet."""
        shape = self.regime.history, len(self.half)
        self.past = torch.zeros(shape, dtype=torch.float64)
        return self.env.reset(**options)

    def step(self, action: Any):
        """Send the actuators what they make of the command."""
        command = torch.as_tensor(np.asarray(action)).double()
        row, state = self.regime.encode(self.faults.values).double(), torch.zeros(1)
        effect = self.regime.apply(command, row, state, self.past).numpy()
        noise = self.random.standard_normal(len(effect)) * self.faults.noise
        self.past = torch.cat([command[None], self.past[:-1]])
        self.effect = (effect + noise * self.half).astype(self.action_space.dtype)
        return self.env.step(self.effect)


class Side:
    """One of the two robots."""

    def __init__(self, robot: Robot, faults: Faults, corrected: bool) -> None:
        self.robot, self.act = robot, robot.policy()
        self.env: Any = Actuators(robot.make(), faults)
        if corrected:
            model, corrector = robot.model, robot.corrector()
            self.env = ActionFlowWrapper(self.env, **model, corrector=corrector, belief=True)
        self.rewards: deque[float] = deque(maxlen=KEPT)
        self.commands: deque[np.ndarray] = deque(maxlen=KEPT)
        self.falls = 0
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin anew."""
        self.observation, self.info = self.env.reset(seed=seed)
        self.steps, self.total, self.lying = 0, 0.0, 0.0

    def step(self) -> None:
        """Act once; a robot that fell lies for a moment and begins anew."""
        if self.lying > 0:
            self.lying -= self.robot.dt
            if self.lying <= 0:
                self.reset(self.falls)
            return
        planned = self.act(self.observation)
        self.observation, reward, over, _, self.info = self.env.step(planned)
        self.steps, self.total = self.steps + 1, self.total + float(reward)
        self.rewards.append(float(reward))
        executed = self.info.get("afm", {}).get("executed", planned)
        self.commands.append(np.stack([planned, executed, self.effect]))
        if over:
            self.falls, self.lying = self.falls + 1, LYING

    @property
    def effect(self) -> np.ndarray:
        """What the actuators gave in the newest step, ``(A,)``."""
        env = self.env
        while not isinstance(env, Actuators):
            env = env.env
        return env.effect

    @property
    def inner(self) -> Any:
        """The innermost environment."""
        return self.env.unwrapped


class World:
    """Both robots; whoever reads or changes them holds the ``lock``.

    >>> from afm_rl.play.robots import make_robot
    >>> world = World(make_robot("pendulum"))
    >>> world.faults.values = {"gain_0": -1.0}
    >>> world.step()
    >>> world.sides["AFM"].steps
    1
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, self.faults, self.lock = robot, Faults(), RLock()
        self.sides = {name: Side(robot, self.faults, name == "AFM") for name in SIDES}
        self.seed, self.direction = 0, 1.0

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
