"""The optimisers: steps that do not overshoot, and an Adam that is new at every step."""

import pytest
import torch
from harness import refused
from torch import nn

from afm_rl.learning import ObGD, ResetAdam


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_step_follows_the_equations():
    weight, bias = nn.Parameter(draw(3, 2)), nn.Parameter(draw(2))
    optimizer = ObGD([weight, bias], lr=0.5, kappa=3.0)
    expected = [weight.detach().clone(), bias.detach().clone()]
    for step, delta in enumerate((0.3, -4.0, 1e-3, 0.0)):
        weight.grad = draw(3, 2, seed=step)
        bias.grad = draw(2, seed=10 + step) if step != 1 else None
        optimizer.step(delta)
        gradients = [0.0 * p if p.grad is None else p.grad for p in (weight, bias)]
        bound = 0.5 * 3.0 * max(abs(delta), 1.0) * sum(g.abs().sum() for g in gradients)
        for value, gradient in zip(expected, gradients, strict=True):
            value -= 0.5 / max(1.0, bound) * delta * gradient
        torch.testing.assert_close([weight.data, bias.data], expected)
    assert not optimizer.state  # nothing is stored


def test_traces_remember_gradients():
    weight = nn.Parameter(draw(3, 2))
    optimizer = ObGD([weight], trace=0.5)
    expected, trace = weight.detach().clone(), torch.zeros(3, 2, dtype=torch.float64)
    for step in range(3):
        weight.grad = draw(3, 2, seed=step)
        optimizer.step()
        trace = 0.5 * trace + weight.grad
        expected -= trace / max(1.0, 2.0 * trace.abs().sum())
        torch.testing.assert_close(weight.data, expected)


def test_groups_are_bounded_apart():
    left, right = (nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizer = ObGD([{"params": [left]}, {"params": [right], "kappa": 4.0}])
    left.grad = right.grad = torch.full((2,), 100.0)
    optimizer.step()
    torch.testing.assert_close(left.data, torch.full((2,), -0.25))
    torch.testing.assert_close(right.data, torch.full((2,), -0.125))


def stepped(delta):
    weights = nn.Parameter(torch.zeros(3, 2))
    weights.grad = torch.ones(3, 2)
    ObGD([weights], lead_dims=1).step(delta)


@refused(
    (lambda: ObGD(parameters(), lr=0.0), "updater.lr"),
    (lambda: ObGD(parameters(), trace=1.5), "updater.trace"),
    (lambda: ObGD(parameters(), lead_dims=-1), "updater.lead_dims"),
    (lambda: ObGD(parameters(), lead_dims=2), "updater.lead_dims"),  # one parameter has one
    (lambda: ObGD(parameters(), lead_dims=1), r"lead_dims=1: parameters of shape \(4, 3\) and"),
    (lambda: stepped(torch.ones(2)), r"delta of shape \(2,\): expected .* \(3,\)"),
    (lambda: stepped(float("nan")), "delta"),
)
def test_what_does_not_fit_is_refused(make):
    make()


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
    monkeypatch.setattr(ResetAdam, "piece", size)
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
