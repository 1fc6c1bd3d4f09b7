"""Keys as YAML writes them become keys as tensordict reads them."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.spaces.keys import as_key, as_keys


@pytest.mark.parametrize(
    ("written", "key"),
    [
        ("action", "action"),
        (["action"], "action"),
        (["afm", "executed_action"], ("afm", "executed_action")),
        (("a", "b", "c"), ("a", "b", "c")),
    ],
)
def test_a_key_is_a_string_or_a_tuple(written, key):
    assert as_key(written) == key
    data = TensorDict({}, [2]).set(as_key(written), torch.ones(2))
    assert data.get(key).sum() == 2


def test_keys_are_converted_one_by_one():
    assert as_keys([["a", "b"], "c"]) == [("a", "b"), "c"]
    assert as_keys([]) == []
