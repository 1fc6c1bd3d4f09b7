"""Gradient descent that does not overshoot, against its formulas and on problems of its kind."""

import copy

import pytest
import torch
from torch import nn

from afm_rl.errors import ConfigurationError
from afm_rl.learning import ObGD

PROBLEMS = 1000


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("lmbda", [0.0, 0.8])
@pytest.mark.parametrize(("lr", "kappa"), [(1.0, 2.0), (30.0, 1.0), (1e-3, 2.0)])
def test_no_step_overshoots_on_its_sample(lr, kappa, lmbda):
    weights = nn.Parameter(draw(PROBLEMS, 20))
    optimizer = ObGD([weights], lr=lr, kappa=kappa, lmbda=lmbda, lead_dims=1)
    scale = 10.0 ** draw(PROBLEMS, seed=1)  # targets of all sizes
    for seed in range(5):
        inputs = 2 * torch.rand(PROBLEMS, 20, dtype=torch.float64) - 1
        target = scale * draw(PROBLEMS, seed=10 + seed)
        before = target - (weights * inputs).sum(-1)
        optimizer.zero_grad()
        (-(weights * inputs).sum()).backward()
        optimizer.step(before.detach())
        change = before - (target - (weights * inputs).sum(-1))
        largest = inputs.abs().amax(-1) / (kappa * before.abs().clamp_min(1))
        assert (change.abs() <= largest * before.abs() * (1 + 1e-9)).all()
        if lmbda == 0:  # a trace may point elsewhere, a gradient does not
            assert (change * before > 0).all()
            assert ((before - change) * before > 0).all()  # the sign stays


def test_small_steps_are_those_of_gradient_descent():
    ours, theirs = (nn.Parameter(draw(6)) for _ in range(2))
    left, right = ObGD([ours], lr=1e-4), torch.optim.SGD([theirs], lr=1e-4)
    for step in range(5):
        ours.grad = draw(6, seed=step)
        theirs.grad = ours.grad.clone()
        left.step(), right.step()
    torch.testing.assert_close(ours, theirs)
    assert not left.state  # without traces nothing is stored


def test_a_step_follows_the_equations():
    weight, bias = nn.Parameter(draw(3, 2)), nn.Parameter(draw(2))
    optimizer = ObGD([weight, bias], lr=0.5, kappa=3.0, gamma=0.9, lmbda=0.7)
    traces = [torch.zeros_like(weight), torch.zeros_like(bias)]
    expected = [weight.detach().clone(), bias.detach().clone()]
    for step, delta in enumerate((0.3, -4.0, 1e-3)):
        weight.grad = draw(3, 2, seed=step)
        bias.grad = draw(2, seed=10 + step) if step != 1 else None  # its trace decays all the same
        optimizer.step(delta)
        for trace, parameter in zip(traces, (weight, bias), strict=True):
            trace *= 0.9 * 0.7
            trace += 0.0 if parameter.grad is None else parameter.grad
        size = sum(trace.abs().sum() for trace in traces)
        bound = 0.5 * 3.0 * max(abs(delta), 1.0) * size
        for value, trace in zip(expected, traces, strict=True):
            value -= 0.5 / max(1.0, bound) * delta * trace
        torch.testing.assert_close([weight.data, bias.data], expected)


@pytest.mark.parametrize("lmbda", [0.0, 0.6])
@pytest.mark.parametrize("lead", [(3,), (2, 3)], ids=str)
def test_stacked_learners_equal_a_loop(lead, lmbda):
    shapes = [(4, 2), (1, 2), ()]
    stacked = [nn.Parameter(draw(*lead, *shape, seed=k)) for k, shape in enumerate(shapes)]
    optimizer = ObGD(stacked, lmbda=lmbda, lead_dims=len(lead))
    index = [tuple(i) for i in torch.ones(lead).nonzero().tolist()]
    alone = {i: [nn.Parameter(p.detach()[i].clone()) for p in stacked] for i in index}
    singles = {i: ObGD(parameters, lmbda=lmbda) for i, parameters in alone.items()}
    for step in range(4):
        delta = draw(*lead, seed=100 + step)
        for k, parameter in enumerate(stacked):
            parameter.grad = 10.0 ** (step - 2) * draw(*parameter.shape, seed=10 * step + k)
        optimizer.step(delta)
        for i in index:
            for parameter, whole in zip(alone[i], stacked, strict=True):
                parameter.grad = whole.grad[i].clone()
            singles[i].step(float(delta[i]))
    for i in index:
        for parameter, whole in zip(alone[i], stacked, strict=True):
            torch.testing.assert_close(parameter, whole[i])


def test_values_of_a_random_walk_are_found():
    """Steps left or right from the middle of 7 states; beyond the right end waits a reward."""
    states, walkers, middle = 7, 64, 3
    dice = torch.Generator().manual_seed(0)
    true = (1 + torch.arange(states)) / (states + 1)
    values = nn.Parameter(torch.full((walkers, states), 0.5))
    optimizer = ObGD([values], lr=1.0, lmbda=0.9, lead_dims=1)
    place, rows = torch.full((walkers,), middle), torch.arange(walkers)
    for step in range(6000):
        if step in (2000, 4000):  # at first, the bound alone sets the size of the steps
            optimizer.param_groups[0]["lr"] *= 0.1
        after = place + 2 * torch.randint(2, (walkers,), generator=dice) - 1
        done, reward = (after < 0) | (after == states), (after == states).float()
        ahead = values.data[rows, after.clamp(0, states - 1)]
        delta = reward + torch.where(done, 0.0, ahead) - values.data[rows, place]
        values.grad = -nn.functional.one_hot(place, states).float()
        optimizer.step(delta)
        optimizer.reset(done)
        place = torch.where(done, middle, after)
    torch.testing.assert_close(values.data.mean(0), true, rtol=0, atol=0.02)
    assert (values.data - true).square().mean(-1).sqrt().max() < 0.15  # each walker by itself


def test_traces_are_forgotten_where_asked():
    weights = nn.Parameter(torch.zeros(2, 3))
    optimizer = ObGD([weights], lmbda=1.0, lead_dims=1)
    weights.grad = torch.ones(2, 3)
    optimizer.step(0.0)
    assert torch.equal(weights.data, torch.zeros(2, 3))  # no error, no step
    optimizer.reset(torch.tensor([True, False]))
    weights.grad = None
    optimizer.step(torch.ones(2))
    assert torch.equal(weights.data[0], torch.zeros(3)) and (weights.data[1] < 0).all()
    optimizer.reset()
    before = weights.data.clone()
    optimizer.step()
    assert torch.equal(weights.data, before)


def test_learning_goes_on_from_a_stored_state():
    one = nn.Parameter(draw(4))
    first = ObGD([one], lmbda=0.9)
    one.grad = draw(4, seed=1)
    first.step(0.5)
    two = nn.Parameter(one.detach().clone())
    second = ObGD([two])
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for parameter, optimizer in ((one, first), (two, second)):
        parameter.grad = draw(4, seed=2)
        optimizer.step(0.5)
    assert torch.equal(one, two)


def test_a_closure_is_evaluated_with_gradients():
    weight = nn.Parameter(torch.tensor([3.0]))
    optimizer = ObGD([weight])

    def closure():
        optimizer.zero_grad()
        loss = weight.square().sum()
        loss.backward()
        return loss.item()

    with torch.no_grad():
        assert optimizer.step(closure=closure) == 9.0
    torch.testing.assert_close(weight.data, torch.tensor([2.5]))  # 3 - 6 / (2 * 6)


def test_groups_are_bounded_apart():
    left, right = (nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizer = ObGD([{"params": [left]}, {"params": [right], "kappa": 4.0}])
    left.grad = right.grad = torch.full((2,), 100.0)
    optimizer.step()
    torch.testing.assert_close(left.data, torch.full((2,), -0.25))
    torch.testing.assert_close(right.data, torch.full((2,), -0.125))


@pytest.mark.parametrize(
    "settings",
    [
        {"lr": 0.0},
        {"lr": float("nan")},
        {"kappa": -1.0},
        {"gamma": 1.1},
        {"lmbda": -0.1},
        {"lead_dims": -1},
        {"lead_dims": 2},  # one of the parameters has a single dimension
    ],
    ids=str,
)
def test_impossible_settings_are_refused(settings):
    parameters = [nn.Parameter(torch.zeros(3, 2)), nn.Parameter(torch.zeros(3))]
    with pytest.raises(ConfigurationError, match=f"updater.{next(iter(settings))}"):
        ObGD(parameters, **settings)


def test_learners_that_do_not_fit_are_refused():
    with pytest.raises(ConfigurationError, match=r"lead_dims=1: parameters of shape \(3, 2\) and"):
        ObGD([nn.Parameter(torch.zeros(3, 2)), nn.Parameter(torch.zeros(2, 2))], lead_dims=1)
    weights = nn.Parameter(torch.zeros(3, 2))
    optimizer = ObGD([weights], lmbda=0.5, lead_dims=1)
    weights.grad = torch.ones(3, 2)
    with pytest.raises(ConfigurationError, match=r"delta of shape \(2,\): expected .* \(3,\)"):
        optimizer.step(torch.ones(2))
    for delta in (float("nan"), "1", None):
        with pytest.raises(ConfigurationError, match="delta"):
            optimizer.step(delta)
    optimizer.step()
    weights.data, weights.grad = weights.data[:2], None
    with pytest.raises(ConfigurationError, match=r"call reset\(\) when learners come or go"):
        optimizer.step()
    optimizer.reset()
    optimizer.step()
