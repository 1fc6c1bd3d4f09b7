"""A ferry on a lake, as a TorchRL environment."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase


def drift(state: Tensor, action: Tensor) -> Tensor:
    """Return the place (m) after one step with velocity ``action`` (m/s)."""
    return state + 0.2 * action


class Ferry(EnvBase):
    """Reach a landing; the propeller may turn the wrong way.

    Args:
        gain: what the propeller makes of an action.
        goal: place of the landing (m).
    """

    def __init__(self, gain: float = 1.0, goal: Sequence[float] = (3.0, 2.0)) -> None:
        super().__init__()
        self.gain = gain
        self.goal = torch.tensor(goal)
        self.observation_spec = Composite(observation=Unbounded((2,)), goal=Unbounded((2,)))
        self.action_spec = Bounded(-1.0, 1.0, (2,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        return self._at(torch.zeros(2))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        there = self._at(drift(tensordict["observation"], self.gain * tensordict["action"]))
        distance = (there["observation"] - self.goal).norm(dim=-1, keepdim=True)
        return there.update({"reward": -distance, "done": distance < 0.3})

    def _at(self, place: Tensor) -> TensorDictBase:
        return TensorDict({"observation": place, "goal": self.goal}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""
