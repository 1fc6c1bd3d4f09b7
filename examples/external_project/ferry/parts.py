"""Parts for the command line of afm-rl: ``afm-rl "trust=[ferry]" robot=lake corrector=reverse``."""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from afm_rl.correction import Correction, Corrector
from afm_rl.correction.base import Fields
from afm_rl.dynamics import DynamicsModel
from afm_rl.planning import Cost, PlanningEnv
from afm_rl.regimes import Regime


def drift(place: Tensor, speed: Tensor) -> Tensor:
    """A step function: the place (m) after a step with a speed (m/s), batched."""
    return place + 0.2 * speed


def near(place: Tensor, speed: Tensor, after: Tensor) -> Tensor:
    """A reward: minus the distance (m) from the landing."""
    return -(after - after.new_tensor([3.0, 2.0])).norm(dim=-1)


class Current(Regime):
    """A regime: the lake's current adds to every speed (m/s)."""

    names = ("east", "north")
    identity = (0.0, 0.0)
    span = (-0.3, 0.3)

    def apply(self, action, parameters, state, past=None, noise=None):
        return action + parameters


class Dock(Cost):
    """A cost: the squared distance from the landing, and a price on speed."""

    def __init__(self, landing: list[float], price: float) -> None:
        super().__init__()
        self.in_keys, self.in_sizes = [], []
        self.register_buffer("landing", torch.tensor(landing), persistent=False)
        self.price = price

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        miss = (next_state - self.landing).square().sum(-1)
        return miss + self.price * action.square().sum(-1)


def straight(world: PlanningEnv, landing: list[float]) -> TensorDictModule:
    """A planner: full speed towards the landing."""

    def steer(place: Tensor) -> Tensor:
        return (5 * (place.new_tensor(landing) - place)).clamp(-1, 1)

    return TensorDictModule(steer, in_keys=["observation"], out_keys=["action"])


class Reverse(Corrector):
    """A corrector: executes the opposite while the last move went against its action."""

    def answer(
        self, memory: Fields, planned: Tensor, model: DynamicsModel, bounds: Tensor, limits: Tensor
    ) -> tuple[Fields, Correction]:
        names = ("states", "actions", "next_states", "valid")
        state, executed, after, valid = (memory[name][..., -1, :] for name in names)
        along = ((after - state) * (model(state, executed) - state)).sum(-1)
        against = (valid[..., 0] > 0) & (along < 0)
        chosen = torch.where(against.unsqueeze(-1), -planned, planned)
        correction = self.unchanged(planned, along.abs(), bounds)
        return {}, correction._replace(executed_action=chosen, corrected=against)


def reverse(robot, dynamics, recent: int) -> Reverse:
    """Make the corrector for a robot's actions."""
    return Reverse(*robot.action_bounds, recent=recent)
