"""Agents: planners with and without the hand-over, corrected, uncorrected, and an oracle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from handover import Handover
from identifier import PhysicsIdentifier
from plant import LENGTHS, SPACE, TIPS, VOLTAGE, Plant, step
from tensordict import TensorDict
from torch import Tensor

from afm_rl.dynamics import ParametricDynamics
from afm_rl.learning import GaussianNLLLoss
from afm_rl.planning import ICEM, MPPI, PlanningEnv, TrackingCost
from afm_rl.transforms.policy import ActionFlowPolicy

MIDDLE = {"length": sum(LENGTHS) / 2, "tip": sum(TIPS) / 2}
NOISE = [
    0.002,
    0.002,
    0.05,
    0.05,
]  # rad, rad/s: error that remains with the grid of lengths and masses


class Model(ParametricDynamics):
    """The equations with a length and a tip mass of each pendulum; plans are coarser in time."""

    def __init__(self) -> None:
        super().__init__(partial(step, substeps=2), SPACE, 1, MIDDLE, NOISE)

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        now, states = state.unsqueeze(-2).expand(*actions.shape[:-2], -1), []
        physics = self._physics_for(actions.dim() - 2)
        for action in actions.unbind(-2):
            now = step(now, action, physics, substeps=1)
            states.append(now)
        return torch.stack(states, -2)


class Agent:
    """An agent of pendulums side by side, which begins with the plant in the middle of the range.

    Args:
        count: of pendulums.
        far: makes the planner that swings up.
        level: cost to go below which LQR takes over; 0 for the planner alone.
        correct: whether the motor is corrected.
        learn: whether length and tip mass are learned.
        informed: whether the agent knows the plant, as an oracle does.
    """

    def __init__(
        self,
        count: int,
        far: Callable,
        level: float = 4.0,
        cap: float = 20.0,
        correct: bool = True,
        learn: bool = True,
        informed: bool = False,
    ) -> None:
        self.model, self.informed = Model(), informed
        cost = TrackingCost([0.01, 1.0, 0.002, 0.01], [0.002], [], angles=[0, 1], in_keys=[])
        env = PlanningEnv(self.model, cost, [-VOLTAGE], [VOLTAGE])
        self.planner = Handover(env, far, level, cap)
        self.model.expand_(count)
        self.policy = ActionFlowPolicy(self.model, self.planner.action_spec, enabled=correct)
        td = TensorDict(batch_size=[count])
        for part in (self.planner, self.policy):
            td = part.make_tensordict_primer()(td)
        self.td, self.signs = td, torch.ones(count, 1)
        self.correct, self.updater = correct and not informed, None
        if learn and not informed:
            ranges = {"length": LENGTHS, "tip": TIPS}
            loss = GaussianNLLLoss(self.model)
            self.updater = PhysicsIdentifier(loss, ranges, [VOLTAGE], count=21)

    def inform(self, plants: Sequence[Plant]) -> None:
        """Set the plants, if the agent is informed."""
        if self.informed:
            rows = torch.tensor([[plant.length, plant.tip] for plant in plants])
            self.model.set_physics(rows)
            self.signs = torch.tensor([[float(plant.sign)] for plant in plants])

    def act(self, state: Tensor) -> Tensor:
        """Return the voltages ``(B, 1)`` for states ``(B, 4)``."""
        self.td.set("observation", state.float())
        self.planner(self.td)
        if self.correct:
            self.policy(self.td)
        return self.td.get("action") * self.signs

    def learn(self, after: Tensor) -> None:
        """Learn from the states after the voltages."""
        self.td.set(("next", "observation"), after.float())
        if self.updater is not None:
            self.updater(self.td)
        carried = self.td.get("next").exclude("observation")
        self.td = self.td.exclude("next").update(carried)


CEM = partial(ICEM, horizon=14, candidates=128, iterations=2, elites=12, sigma=0.8, beta=1.0)
PATHS = partial(MPPI, horizon=14, candidates=128, iterations=2, temperature=0.5, sigma=0.6)
METHODS = {
    "iCEM+LQR": partial(Agent, far=CEM),
    "MPPI+LQR": partial(Agent, far=PATHS),
    "iCEM": partial(Agent, far=CEM, level=0.0, cap=0.0),
    "MPPI": partial(Agent, far=PATHS, level=0.0, cap=0.0),
    "uncorrected": partial(Agent, far=CEM, correct=False),
    "oracle": partial(Agent, far=CEM, informed=True),
}
