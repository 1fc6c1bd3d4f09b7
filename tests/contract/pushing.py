"""What can be pickled: it belongs to a module with a name of its own."""

import gymnasium
import torch

from afm_rl.dynamics import Dubins


def push(state, action):
    return state + 0.1 * torch.cat([action, action[..., :1]], -1)


class Car(gymnasium.Env):
    """The ground robot; it keeps its state to itself, as gymnasium's do: only such skip frames."""

    observation_space = gymnasium.spaces.Box(-100.0, 100.0, (3,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, ends=None):
        self.ends = ends

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.count = torch.tensor([5.0, -3.0, 1.0]), 0
        return self.state.numpy(), {}

    def step(self, action):
        self.state, self.count = Dubins()(self.state, torch.as_tensor(action)), self.count + 1
        return self.state.numpy(), 0.0, self.count == self.ends, False, {}
