"""Missions that share a model do not disturb each other, whatever the model was asked before."""

import gymnasium
import pytest
import torch
from torchrl.data import Bounded

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.transforms import CorrectionLoop


@pytest.mark.check
def test_interleaved_missions_have_the_commands_of_each_alone():
    """Also of a model whose derivatives are kept: they belong to the memory."""
    model = MuJoCoDynamics(gymnasium.make("Humanoid-v5"))
    assert model.keeps_derivative
    low, high = model.action_low.double(), model.action_high.double()
    spec = Bounded(low, high, low.shape, dtype=low.dtype)
    loop = CorrectionLoop("test", model).complete(action_spec=spec)

    def mission(seed, steps=12):
        """Drive a robot whose motors are reversed; yield the commands."""
        draws = torch.Generator().manual_seed(seed)
        state = torch.zeros(model.state_size).double()
        state[2], state[3] = 1.4, 1.0
        memory, _ = loop.begin(state, spec)
        for _ in range(steps):
            plan = 0.3 * (2 * torch.rand(low.shape, generator=draws).double() - 1)
            memory, step = loop.act(memory, plan, spec)
            yield step.executed_action
            state = model(state, -step.executed_action)
            memory = loop.observe(memory, state)

    alone = [torch.stack([*mission(seed)]) for seed in (0, 1)]
    pairs = zip(mission(0), mission(1), strict=True)
    together = [torch.stack(commands) for commands in zip(*pairs, strict=True)]
    assert all(map(torch.equal, alone, together))
    assert (alone[0][-1] != 0).any()
