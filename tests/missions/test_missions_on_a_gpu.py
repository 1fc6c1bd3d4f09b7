"""Missions and training of every kind of method on a GPU that need not be there."""

import pytest
import torch
from fake_gpu import DEVICE, FakeGPU

from afm_rl.missions.run import _advance, _start

ALWAYS = {  # what a step waits for, whatever the method
    "env._checked",  # is an action not finite?
    "compose._active",  # which families of regimes are there?
    "state.add",  # the log is kept on the CPU
    "run._advance",  # has a mission ended?
}
LEARNING = {"updater.forward"}
METHODS = {"oracle": set(), "afm_physics": set(), "online_pe": LEARNING, "rls": LEARNING}


@pytest.mark.parametrize("method", METHODS)
def test_training_and_missions_stay_on_their_device(make_agent, monkeypatch, method):
    agent = make_agent(f"method={method}", "seeds=2", "budget=50")
    values = "envs.missions.format.MissionFormat._check_values"
    monkeypatch.setattr(f"afm_rl.{values}", lambda *_: None)
    with FakeGPU(answer=False) as gpu, torch.no_grad():
        gpu.move(agent)
        for part in agent.trainings:
            part.train(False)
        loop = _start(agent)
        _advance(agent, loop)  # at first it looks at who is there
        gpu.waits.clear()
        _advance(agent, loop)
        for entry in loop.td.values(True, True):
            assert entry.device == DEVICE
        assert set(gpu.waits) == ALWAYS | METHODS[method]
