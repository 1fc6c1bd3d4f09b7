import pytest
import torch
from harness import agent_of

from afm_rl.errors import ConfigurationError
from afm_rl.missions.collected import transitions


@pytest.fixture
def robot():
    return agent_of("robot=gymnasium", "method=frozen_pe").robot


def test_data_under_regimes_are_of_each_by_turns(robot):
    healthy, changed = (
        transitions(robot, 32, 0, regimes=regimes)
        for regimes in ((), [{"gain_0": 0.0}, {"gain_0": 1.0}])
    )

    def missed(data, gain):
        """Error of the nominal model with part of the action, for each of eight episodes."""
        ahead = robot.model(data["observation"], gain * data["action"])
        return (ahead - data["next", "observation"]).abs().reshape(8, -1).amax(1)

    assert torch.equal(missed(healthy, 1.0), torch.zeros(8))
    assert torch.equal(missed(changed, 0.0)[::2], torch.zeros(4))
    assert torch.equal(missed(changed, 1.0)[1::2], torch.zeros(4))
    assert (missed(changed, 1.0)[::2] > 0).all()


def test_regimes_of_data_have_known_parameters(robot):
    with pytest.raises(ConfigurationError, match="unknown parameter 'gain_7'"):
        transitions(robot, 8, 0, regimes=[{"gain_7": 0.0}])
