"""Dynamics that are written down."""

import threading

import pytest
import torch
from harness import refused

from afm_rl.dynamics import DynamicsModel, KnownDynamics
from afm_rl.spaces.manifold import Manifold


def push(state, action):
    """A cart: position (m), speed (m/s); force (N)."""
    return state + 0.1 * torch.cat([state[..., 1:], action.sin()], -1)


def cart(**settings):
    return KnownDynamics(push, Manifold(2), action_size=1, **settings)


def test_any_step_function_is_a_model():
    model, state, action = cart(), torch.randn(5, 4, 2), torch.randn(5, 4, 1)
    assert torch.equal(model(state, action), push(state, action))
    mean, log_variance = model.moments(state, action)
    assert mean.shape == (5, 4, 1, 2) and torch.equal(log_variance, torch.zeros(5, 4, 1, 2))
    change = push(state, action) - state
    torch.testing.assert_close(mean.squeeze(-2), model.standardise(change))


def test_two_threads_may_ask_for_derivatives_at_once():
    inside, done, found = threading.Event(), threading.Event(), []

    def slow(state, action):
        inside.set()
        done.wait(0.2)  # the other thread has all this time to meet this one
        return push(state, action)

    def ask(step):
        model = KnownDynamics(step, Manifold(2), action_size=1)
        found.append(model.jacobian(torch.zeros(2), torch.zeros(1)))

    first = threading.Thread(target=ask, args=(slow,))
    first.start()
    inside.wait()
    ask(push)
    done.set()
    first.join()
    assert torch.equal(*found)


@pytest.mark.parametrize(
    ("given", "noise"), [(0.1, [0.1, 0.1]), ([0.1, 0.2], [0.1, 0.2]), ([0.3], [0.3, 0.3])]
)
def test_the_noise_is_one_number_or_one_per_coordinate(given, noise):
    model = cart(noise_std=given)
    for dtype in (torch.float32, torch.float64):
        state = torch.zeros(3, 2, dtype=dtype)
        expected, scale = model.forecast(state, torch.zeros(3, 1, dtype=dtype))
        assert scale.dtype is expected.dtype is dtype
        torch.testing.assert_close(scale, torch.tensor(noise, dtype=dtype).expand(3, 2))
    torch.testing.assert_close(model.standardise(torch.ones(2)), 1 / torch.tensor(noise))


def test_a_model_of_ones_own_needs_three_methods():
    class Still(DynamicsModel):
        def forward(self, state, action):
            return state + 0.0 * action

        def moments(self, state, action):
            zero = torch.zeros_like(state).unsqueeze(-2)
            return zero, zero

        def noise_scale(self, state, action):
            return torch.ones_like(state)

    model, state = Still(Manifold(1), 1), torch.randn(4, 1)
    assert torch.equal(model.standardise(state), state) and model.state_size == 1
    assert torch.equal(model.forecast(state, state)[1], torch.ones(4, 1))
    assert torch.equal(model.jacobian(state, state), torch.zeros(4, 1, 1))
    assert model.expand_(3).select_(torch.tensor([0])).lead == ()


@refused(
    (lambda s, a: s.numpy() + 1, "returned ndarray for states"),
    (lambda s, a: torch.stack([s[0] + a[0], s[1]]), r"returned \(2, 2\) for .*, as in state"),
    (lambda s, a: s.sum(-1), r"returned \(4,\) for .*expected a tensor \(4, 2\)"),
    says="dynamics.step: {}",
)
def test_a_step_function_that_is_not_in_torch_or_not_batched_is_named(step):
    KnownDynamics(step, Manifold(2), action_size=1)(torch.zeros(4, 2), torch.zeros(4, 1))
