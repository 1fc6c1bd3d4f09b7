"""The robots of the suite: nominal model, policy and task of each, for many episodes at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from draws import POSITION_NOISE, SPEED_NOISE, WHEELS, drawn_model, drawn_wheels
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

import afm_rl.envs.task
from afm_rl.dynamics import Dubins, DynamicsModel, MuJoCoDynamics
from afm_rl.dynamics.known import ParametricDynamics, PhysicsModel
from afm_rl.planning import load_policy
from afm_rl.spaces.manifold import Manifold, wrap_angle

POLICIES = Path(__file__).parents[3] / "examples" / "policies" / "zoo"
Episode = tuple[int, int]  # level and number of the draw


@dataclass(frozen=True)
class Robot:
    """A robot with its policy and its task.

    States are ``(N, S)``, actions ``(N, A)``, times ``(N,)`` in steps; all in double precision.

    Args:
        model: returns the nominal model; its state is the first part, or all, of the robot's state.
        plant: returns the model of the robot, whose physics can be set.
        physics: row of the physics of a drawn robot.
        low, high: action bounds, ``(A,)``.
        start: returns the first state ``(S,)`` of the episode with that draw.
        observe: returns the observations of states, ``(N, O)``.
        act: returns the planned actions for observations and the times at which they act.
        reward: of states, actions, next states and times, ``(N,)``.
        fallen: returns which states end an episode, ``(N,)``.
        speeds: state coordinates that are speeds.
    """

    model: Callable[[], DynamicsModel]
    plant: Callable[[], PhysicsModel]
    physics: Callable[[int, int], Sequence[float]]
    low: Tensor
    high: Tensor
    start: Callable[[int], Tensor]
    observe: Callable[[Tensor], Tensor]
    act: Callable[[Tensor, Tensor], Tensor]
    reward: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    fallen: Callable[[Tensor], Tensor]
    speeds: slice

    def exact(self, episodes: Sequence[Episode]) -> DynamicsModel:
        """Return the model of the drawn robots, a row for each episode."""
        plant = self.plant()
        plant.set_physics(torch.tensor([self.physics(*episode) for episode in episodes]).double())
        return plant


class DrawnRobots(VectorEnv):
    """Drawn robots side by side, one for each episode, whose readings are noisy.

    The measured state is the attribute ``reading``, ``(N, S)``. A robot that has fallen does
    not move.

    Args:
        robot: the nominal robot.
        episodes: level and number of the draw of each; equal draws have equal noise.
    """

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}

    def __init__(self, robot: Robot, episodes: Sequence[Episode]) -> None:
        self.robot, self.episodes, self.num_envs = robot, episodes, len(episodes)
        low, high = robot.low.numpy(), robot.high.numpy()
        self.single_action_space = Box(low, high, dtype=np.float64)
        self.action_space = gymnasium.vector.utils.batch_space(
            self.single_action_space, self.num_envs
        )
        first = robot.observe(robot.start(0)[None])[0].numpy()
        self.single_observation_space = Box(-np.inf, np.inf, first.shape, dtype=np.float64)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self.plant = robot.exact(episodes)
        self.deviation = torch.full((len(robot.start(0)),), POSITION_NOISE).double()
        self.deviation[robot.speeds] = SPEED_NOISE

    def reset(self, *, seed: Any = None, options: Any = None):
        """Begin the episodes; with a seed from other starts, with other noise."""
        other = seed or 0
        self.noise = [np.random.default_rng([1 + other, draw]) for _, draw in self.episodes]
        starts = [self.robot.start(1000 * other + draw) for _, draw in self.episodes]
        self.state = torch.stack(starts)
        self.time = torch.zeros(self.num_envs)
        self.fallen = torch.zeros(self.num_envs, dtype=torch.bool)
        return self._read(), {}

    def step(self, actions: Any):
        """Move every robot by one step."""
        action = torch.as_tensor(actions).double()
        after = self.plant(self.state, action)
        finite = after.isfinite().all(-1)
        after = torch.where((finite & ~self.fallen)[:, None], after, self.state)
        rewards = self.robot.reward(self.state, action, after, self.time)
        self.fallen |= ~finite | self.robot.fallen(after)
        self.state, self.time = after, self.time + 1
        truncated = np.zeros(self.num_envs, dtype=bool)
        return self._read(), rewards.numpy(), self.fallen.numpy().copy(), truncated, {}

    def _read(self) -> np.ndarray:
        """Read the states, and return the observations in them."""
        drawn = np.stack([each.standard_normal(len(self.deviation)) for each in self.noise])
        levels = torch.tensor([float(level) for level, _ in self.episodes])[:, None]
        self.reading = self.state + levels * self.deviation * torch.from_numpy(drawn)
        return self.robot.observe(self.reading).numpy()


def locomotion(policy: str, task: str, speed_limit: float, effort: float, alive: float) -> Robot:
    """Return a robot of gymnasium with a policy of the zoo: the speed ahead is its reward.

    Args:
        policy: name of the file in ``examples/policies/zoo``.
        task: gymnasium's name of the environment.
        speed_limit: largest observed speed.
        effort: cost of a squared action.
        alive: reward for not falling; 0 for a robot that cannot fall.
    """
    env = gymnasium.make(task).unwrapped
    trained, nq = load_policy(POLICIES / f"{policy}.safetensors")[0], env.model.nq

    def start(draw: int) -> Tensor:
        env.reset(seed=draw)
        return torch.from_numpy(env.state_vector())

    def observe(state: Tensor) -> Tensor:
        return torch.cat(
            [state[:, 1:nq], state[:, nq:].clamp(-speed_limit, speed_limit)], -1
        )  # the place on the ground is not observed

    def reward(state: Tensor, action: Tensor, after: Tensor, time: Tensor) -> Tensor:
        speed = (after[:, 0] - state[:, 0]) / env.dt
        return speed - effort * action.square().sum(-1) + alive * ~fallen(after)

    def fallen(state: Tensor) -> Tensor:
        if not alive:
            return torch.zeros(len(state), dtype=torch.bool)
        height, pitch = state[:, 1], state[:, 2]
        (low, high), (back, front) = env._healthy_z_range, env._healthy_angle_range
        return ~((height > low) & (height < high) & (pitch > back) & (pitch < front))

    def model() -> MuJoCoDynamics:
        return MuJoCoDynamics(env, change=drawn_model, physics={"level": 0, "draw": 0})

    return Robot(
        model=model,
        plant=model,
        physics=lambda level, draw: [level, draw],
        low=torch.from_numpy(env.action_space.low).double(),
        high=torch.from_numpy(env.action_space.high).double(),
        start=start,
        observe=observe,
        act=lambda observation, time: trained(observation.float()).double(),
        reward=reward,
        fallen=fallen,
        speeds=slice(nq, None),
    )


def arm() -> Robot:
    """Return an arm with seven position servos that tracks sines of its joint angles.

    The reward of a step is exp(-e / .1), e the root mean square error of the angles (rad).
    """
    file = Path(afm_rl.envs.task.__file__).with_name("arm.xml")

    def model() -> MuJoCoDynamics:
        return MuJoCoDynamics(file, 5, change=drawn_model, physics={"level": 0, "draw": 0})

    nominal = model()
    home, joints = nominal.home, nominal.action_size
    rates = 0.08 * (1 + 0.15 * torch.arange(joints))  # rad a step of 50 ms

    def reference(time: Tensor) -> Tensor:
        return home + 0.4 * (rates * time[:, None] + torch.arange(joints)).sin()

    def act(observation: Tensor, time: Tensor) -> Tensor:
        # A servo lags behind its command by two steps; half of the remaining error is added.
        return reference(time + 3) + 0.5 * (reference(time) - observation[:, :joints])

    def reward(state: Tensor, action: Tensor, after: Tensor, time: Tensor) -> Tensor:
        error = (after[:, :joints] - reference(time + 1)).square().mean(-1).sqrt()
        return (-error / 0.1).exp()

    return Robot(
        model=model,
        plant=model,
        physics=lambda level, draw: [level, draw],
        low=nominal.action_low.double(),
        high=nominal.action_high.double(),
        start=lambda draw: torch.cat([reference(torch.zeros(1))[0], torch.zeros(joints)]).double(),
        observe=lambda state: state,
        act=act,
        reward=reward,
        fallen=lambda state: torch.zeros(len(state), dtype=torch.bool),
        speeds=slice(joints, None),
    )


def direction(vector: Tensor) -> Tensor:
    """Return the angle (rad) of vectors ``(*B, 2)``."""
    return torch.atan2(vector[..., 1], vector[..., 0])


def ground_robot(dt: float = 0.2) -> Robot:
    """Return a robot with two driven wheels that follows a point on an eight.

    The state is x, y (m), heading (rad), v (m/s) and yaw rate (rad/s); actions are the last two.
    The nominal model, :class:`~afm_rl.dynamics.Dubins`, knows the first three, as the policy does.
    The reward of a step is exp(-d / .3), d the distance from the point (m).
    """
    width = 0.5  # m, between the wheels

    def step(state: Tensor, action: Tensor, physics: Tensor) -> Tensor:
        left, right, track, lag, slip = physics.unbind(-1)
        x, y, heading, v, turn = state.unbind(-1)
        asked, yaw = action.unbind(-1)
        left = left * (asked - yaw * width / 2)
        right = right * (asked + yaw * width / 2)
        keep = torch.where(lag > 0, (-dt / lag.clamp_min(1e-9)).exp(), 0.0)
        v = keep * v + (1 - keep) * (1 - slip) * (left + right) / 2
        turn = keep * turn + (1 - keep) * (right - left) / (width * track)
        middle = heading + turn * dt / 2
        after = (
            x + v * dt * middle.cos(),
            y + v * dt * middle.sin(),
            wrap_angle(heading + turn * dt),
        )
        return torch.stack([*after, v, turn], -1)

    def goal(time: Tensor) -> Tensor:
        angle = 0.17 * dt * time[:, None]
        return torch.cat([2 * angle.sin(), (2 * angle).sin()], -1)

    def act(observation: Tensor, time: Tensor) -> Tensor:
        ahead, later = goal(time + 1) - goal(time), goal(time + 2) - goal(time + 1)
        velocity = ahead / dt + 1.5 * (goal(time) - observation[:, :2])
        away = wrap_angle(direction(velocity) - observation[:, 2])
        bend = wrap_angle(direction(later) - direction(ahead)) / dt
        speed = velocity.norm(dim=-1) * away.cos()
        return torch.stack([speed, 3.0 * away + bend], -1).clamp(-high, high)

    def start(draw: int) -> Tensor:
        place = torch.tensor([0.0, 0.0, math.pi / 4, 0.0, 0.0])
        generator = torch.Generator().manual_seed(draw)
        spread = torch.tensor([0.2, 0.2, 0.3, 0.0, 0.0])
        return (place + spread * (2 * torch.rand(5, generator=generator) - 1)).double()

    def reward(state: Tensor, action: Tensor, after: Tensor, time: Tensor) -> Tensor:
        return (-(goal(time + 1) - after[:, :2]).norm(dim=-1) / 0.3).exp()

    high = torch.tensor([1.0, 1.5]).double()
    noise = [1e-3, 1e-3, 1e-3, 0.05, 0.05]
    return Robot(
        model=lambda: Dubins(dt),
        plant=lambda: ParametricDynamics(step, Manifold(5, angles=[2]), 2, WHEELS, noise),
        physics=drawn_wheels,
        low=-high,
        high=high,
        start=start,
        observe=lambda state: state[:, :3],
        act=act,
        reward=reward,
        fallen=lambda state: torch.zeros(len(state), dtype=torch.bool),
        speeds=slice(3, None),
    )


ROBOTS: dict[str, Callable[[], Robot]] = {
    "half_cheetah": lambda: locomotion("half_cheetah_tqc", "HalfCheetah-v5", math.inf, 0.1, 0.0),
    "walker2d": lambda: locomotion("walker2d_tqc", "Walker2d-v5", 10.0, 1e-3, 1.0),
    "hopper": lambda: locomotion("hopper_trpo", "Hopper-v5", 10.0, 1e-3, 1.0),
    "arm": arm,
    "ground_robot": ground_robot,
}
