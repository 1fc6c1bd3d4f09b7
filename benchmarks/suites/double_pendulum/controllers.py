"""Controllers of double pendulums: a stabilised trajectory, a receding horizon, AFM."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from plant import DRIVEN, DT, GOAL, LIMIT, NOMINAL, difference, step
from runs import Controller
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from afm_rl.dynamics import ParametricDynamics
from afm_rl.planning import MPC, PlanningEnv, TrackingCost
from afm_rl.planning.riccati import stationary_value
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import CorrectionLoop
from afm_rl.transforms.loop import chosen_rows

NOISE = [1e-3, 1e-3, 0.03, 0.03]  # rad, rad/s: standard deviation of the model's error
BOX = torch.tensor([[-LIMIT], [LIMIT]], dtype=torch.float64)
TO_TRACK, TO_HOLD = [0.64, 0.56, 0.13, 0.037], [0.97, 0.93, 0.39, 0.26]  # weights of errors
NEAR = {"acrobot": [0.1, 0.1, 0.5, 0.5], "pendubot": [0.05, 0.05, 0.1, 0.1]}


def model_of(robot: str, steps: int) -> ParametricDynamics:
    """Return the nominal model, whose action ``(*B, 1)`` is held for some steps."""
    axis = torch.eye(2, dtype=torch.float64)[DRIVEN[robot]]

    def held(state: Tensor, action: Tensor, physics: Tensor) -> Tensor:
        return step(state, action * axis, NOMINAL._replace(m2=physics[..., 0]), steps * DT)

    return ParametricDynamics(held, Manifold(4), 1, {"m2": NOMINAL.m2}, NOISE)


class Tracking:
    """A swing-up stabilised by time-varying LQR, followed by LQR near the goal.

    The weights are the published ones.

    Args:
        robot: acrobot or pendubot.
        states: of the swing-up, ``(T, 4)``, one each step.
        torques: ``(T,)``.
    """

    period = 5  # steps of the simulation in one of AFM around it

    def __init__(self, robot: str, states: Tensor, torques: Tensor) -> None:
        model = model_of(robot, 1)
        self.states, self.torques = states, torques
        self.goal, self.near = states.new_tensor(GOAL), states.new_tensor(NEAR[robot])
        weights, price = states.new_tensor(TO_HOLD).diag(), states.new_tensor([[0.11]])
        _, move, push = model.linearise(self.goal, states.new_zeros(1))
        value, self.hold = stationary_value(move, push, DT * weights, DT * price)
        _, moves, pushes = model.linearise(states, torques.unsqueeze(-1))
        weights, price = 2 * states.new_tensor(TO_TRACK).diag(), states.new_tensor([[2 * 0.82]])
        if robot == "acrobot":
            value = 50 * weights  # 100 times those of a millisecond
        gains = []
        for A, B in zip(moves.flip(0), pushes.flip(0), strict=True):
            gains.append(torch.linalg.solve(price + B.T @ value @ B, B.T @ value @ A))
            value = weights + A.T @ value @ (A - B @ gains[-1])
        self.gains = torch.cat(gains[::-1])
        self.arrived = torch.tensor(False)

    def __call__(self, state: Tensor, step: int, late: Tensor | int = 0) -> Tensor:
        """Return the torques ``(N,)`` that act ``late`` steps after a step, in these states."""
        now = torch.as_tensor(step + late).clamp(max=len(self.states) - 1)
        error = difference(state, self.states[now])
        torque = self.torques[now] - (self.gains[now] * error).sum(-1)
        off = difference(state, self.goal)
        self.arrived = self.arrived | (off.abs() <= self.near).all(-1)
        return torch.where(self.arrived, -(off @ self.hold[0]), torque).clamp(-LIMIT, LIMIT)


class Receding:
    """Model predictive control over a second, with bounded torques and unbounded plans.

    Args:
        robot: acrobot or pendubot.
        count: of runs.
        weights: of errors.
        price: of torque.
    """

    period = 10  # steps of the simulation in one of a plan

    def __init__(
        self,
        robot: str,
        count: int,
        weights: Sequence[float] = (10.0, 1.0, 0.1, 0.1),
        price: float = 0.1,
    ) -> None:
        cost = TrackingCost(weights, [price], [], GOAL, angles=[0, 1], in_keys=[])
        env = PlanningEnv(model_of(robot, self.period), cost, *BOX)
        self.planner = MPC(env, horizon=50, bounded=[])
        self.td = self.planner.make_tensordict_primer()(TensorDict(batch_size=[count]))
        self.td["mpc", "actions"] += 0.1  # hanging at rest is an equilibrium
        self.torque = torch.zeros(count, dtype=torch.float64)

    def __call__(self, state: Tensor, step: int, late: Tensor | int = 0) -> Tensor:
        """Return the torques ``(N,)`` for these states."""
        if step % self.period == 0:
            self.planner(self.td.set("observation", state))
            self.torque = self.td["action"][:, 0].clamp(-LIMIT, LIMIT)
            self.td = self.td.select().update(self.td["next"])
        return self.torque


class Corrected:
    """AFM with its defaults around a controller, without knowledge of the change.

    Args:
        robot: acrobot or pendubot.
        act: the controller.
        enabled: which runs are corrected, ``(N,)``; None: all.
    """

    def __init__(self, robot: str, act: Tracking | Receding, enabled: Tensor | None = None) -> None:
        self.act, self.period, self.enabled = act, act.period, enabled
        self.memory, self.moved = None, None
        self.spec = Bounded(*BOX, dtype=torch.float64)
        model = model_of(robot, self.period)
        self.loop = CorrectionLoop(robot, model).complete(action_spec=self.spec)

    def __call__(self, state: Tensor, step: int) -> Tensor:
        """Return the corrected torques ``(N,)`` for measured states."""
        if step % self.period == 0:
            loop = self.loop
            if self.memory is None:
                self.memory, _ = loop.begin(state, self.spec)
            else:
                self.memory = loop.observe(self.memory, state)
                if self.moved is not None:
                    begun, _ = loop.begin(state, self.spec, self.memory)  # with what was learnt
                    self.memory = chosen_rows(self.moved, begun, self.memory)
            self.moved = None
            arrival, late = loop.arrival(self.memory, self.enabled)
            planned = self.act(arrival, step, self.period * late).unsqueeze(-1)
            self.memory, record = loop.act(self.memory, planned, self.spec, enabled=self.enabled)
            self.torque = record.executed_action[:, 0]
        return self.torque

    def restart(self, moved: Tensor) -> None:
        """Learn nothing while runs ``(N,)`` are moved by others."""
        self.moved = moved if self.moved is None else self.moved | moved


def differentiated(act: Controller) -> Controller:
    """Return a controller that takes speeds from two measured positions, which have no noise."""
    before: list[Tensor] = []

    def seen(state: Tensor, step: int) -> Tensor:
        angles = state[:, :2]
        speeds = (angles - before.pop()) / DT if before else 0 * angles
        before.append(angles)
        return act(torch.cat([angles, speeds], -1), step)

    return seen
