"""State dicts that others made are checked before anything changes."""

import gymnasium
import pytest
import torch

from afm_rl import ActionFlowWrapper
from afm_rl.errors import ConfigurationError

WRONG = [
    ({"memory": torch.zeros(1, 3)}, r"\['memory'\]: expected \['memory', 'over'\]"),
    ({"memory": torch.zeros(1, 3), "over": torch.zeros(1)}, r"shape \(1, 3\): expected"),
    ({"memory": torch.tensor([torch.nan]), "over": torch.zeros(1)}, "expected finite numbers"),
]


@pytest.mark.parametrize(("state", "words"), WRONG)
def test_a_state_of_others_is_checked_before_anything_changes(state, words):
    env = ActionFlowWrapper(gymnasium.make("Pendulum-v1"), lambda s, a: s)
    env.reset(seed=0)
    before = env.state_dict()
    with pytest.raises(ConfigurationError, match=words):
        env.load_state_dict(state)
    assert env.memory is before["memory"]
    env.load_state_dict(before)
