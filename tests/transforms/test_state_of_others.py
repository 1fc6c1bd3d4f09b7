"""State dicts that others made are checked before anything changes."""

import gymnasium
import pytest
import torch

from afm_rl import ActionFlowWrapper
from afm_rl.errors import ConfigurationError

WRONG = [
    (lambda state: {"over": torch.zeros(1)}, r"\['over'\]: expected \['memory.actions'"),
    (lambda state: state | {"memory.noise": torch.zeros(1, 3)}, r"shape \(1, 3\): expected"),
    (lambda state: state | {"memory.noise": torch.tensor([torch.nan])}, "expected finite numbers"),
]


@pytest.mark.parametrize(("changed", "words"), WRONG)
def test_a_state_of_others_is_checked_before_anything_changes(changed, words):
    env = ActionFlowWrapper(gymnasium.make("Pendulum-v1"), lambda s, a: s)
    env.reset(seed=0)
    before = env.state_dict()
    state, memory = changed(before), env.memory
    with pytest.raises(ConfigurationError, match=words):
        env.load_state_dict(state)
    assert env.memory is memory
    env.load_state_dict(before)
