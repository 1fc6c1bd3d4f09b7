"""What holds for every public module: dynamics, flows, planners, losses, updaters."""

import copy
import pickle

import pytest
import torch
from tensordict import unravel_key
from torch.utils._pytree import tree_leaves


@pytest.mark.parametrize(
    ("batch", "dtype"),
    [((), torch.float64), ((4,), torch.float32), ((2, 3), torch.float64)],
    ids=str,
)
def test_any_batch_in_either_precision(case, batch, dtype):
    said = case.say(case.make(dtype=dtype), batch, dtype=dtype)
    for part in said:
        assert part.shape[: len(batch)] == batch and part.dtype is dtype and part.isfinite().all()


@pytest.mark.parametrize(
    "double",
    [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module))],
    ids=["copied", "pickled"],
)
def test_a_double_says_the_same_and_is_independent(case, double):
    module = case.make()
    twin = double(module)
    before = copy.deepcopy(tree_leaves(twin.state_dict()))
    first = case.say(module, (4,), dtype=torch.float32)
    for value, old in zip(tree_leaves(twin.state_dict()), before, strict=True):
        assert torch.equal(value, old) if isinstance(value, torch.Tensor) else value == old
    torch.testing.assert_close(case.say(twin, (4,), dtype=torch.float32), first)


def test_the_state_dict_holds_all_that_was_learnt(case):
    module, other = case.make(seed=0), case.make(seed=1)
    other.load_state_dict(module.state_dict())
    torch.testing.assert_close(
        case.say(other, (4,), dtype=torch.float32), case.say(module, (4,), dtype=torch.float32)
    )


@pytest.mark.slow
def test_it_says_the_same_compiled(compiled_case):
    make, say = compiled_case
    expected = say(make(), (4,), dtype=torch.float32)
    torch._dynamo.reset()
    compiled = torch.compile(make(), backend="eager")
    torch.testing.assert_close(say(compiled, (4,), dtype=torch.float32), expected)


def test_keys_are_given_as_torchrl_wants_them(case):
    module = case.make()
    for keys in (getattr(module, "in_keys", []), getattr(module, "out_keys", [])):
        assert [unravel_key(key) for key in keys] == list(keys)
