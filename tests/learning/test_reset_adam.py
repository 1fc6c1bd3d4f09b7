"""Adam that is new at every step."""

import pytest
import torch
from torch import nn

from afm_rl.errors import ConfigurationError
from afm_rl.learning import ResetAdam
from afm_rl.learning import optimisers as module


def parameters(seed=0):
    torch.manual_seed(seed)
    return [nn.Parameter(torch.randn(4, 3, dtype=torch.float64)), nn.Parameter(torch.zeros(2))]


def test_each_step_is_the_first_step_of_a_new_adam():
    ours, theirs = parameters(), parameters()
    optimizer = ResetAdam(ours, lr=0.02)
    for step in range(5):
        fresh = torch.optim.Adam(theirs, lr=0.02)
        for left, right in zip(ours, theirs, strict=True):
            left.grad = torch.randn_like(left) * 10.0 ** (step - 6)
            right.grad = left.grad.clone()
        optimizer.step(), fresh.step()
        for left, right in zip(ours, theirs, strict=True):
            torch.testing.assert_close(left, right)


@pytest.mark.parametrize("size", [1, 5, 7, 12, 100])
@pytest.mark.parametrize("turned", [False, True])
def test_pieces_change_nothing(size, turned, monkeypatch):
    monkeypatch.setattr(module, "PIECE", size)
    start, gradient = (torch.randn(4, 3, dtype=torch.float64) for _ in range(2))
    weight = nn.Parameter(start.clone().T if turned else start.clone())
    weight.grad = gradient.T if turned else gradient
    ResetAdam([weight], lr=0.1).step()
    expected = start - 0.1 * gradient / (gradient.abs() + 1e-8)
    torch.testing.assert_close(weight.data.T if turned else weight.data, expected)


def test_what_has_no_gradient_stays():
    still, zero = parameters()
    zero.grad = torch.zeros(2)
    before = still.clone()
    ResetAdam([still, zero], lr=1.0).step()
    assert torch.equal(still, before) and torch.equal(zero, torch.zeros(2))


def test_groups_have_step_sizes_of_their_own():
    slow, fast = (nn.Parameter(torch.zeros(1)) for _ in range(2))
    slow.grad, fast.grad = torch.ones(1), -torch.ones(1)
    ResetAdam([{"params": [slow], "lr": 0.1}, {"params": [fast]}], lr=0.5).step()
    torch.testing.assert_close(torch.cat([slow, fast]).data, torch.tensor([-0.1, 0.5]))


def test_a_closure_is_evaluated_with_gradients():
    weight = nn.Parameter(torch.tensor([3.0]))
    optimizer = ResetAdam([weight], lr=0.5)

    def closure():
        optimizer.zero_grad()
        loss = weight.square().sum()
        loss.backward()
        return loss.item()

    with torch.no_grad():
        assert optimizer.step(closure) == 9.0
    torch.testing.assert_close(weight.data, torch.tensor([2.5]))


@pytest.mark.parametrize("settings", [{"lr": 0.0}, {"lr": float("nan")}, {"eps": 0.0}], ids=str)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigurationError, match=f"updater.{next(iter(settings))}"):
        ResetAdam(parameters(), **settings)
