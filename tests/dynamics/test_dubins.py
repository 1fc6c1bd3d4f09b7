"""The nominal ground robot."""

import math

import torch

from afm_rl.dynamics import Dubins, dubins_step


def test_a_step_by_hand():
    state, action = torch.tensor([1.0, 2.0, math.pi / 6]), torch.tensor([0.8, -0.5])
    moved = dubins_step(state, action, 0.5)
    by_hand = [1 + 0.4 * math.cos(math.pi / 6), 2 + 0.4 * 0.5, math.pi / 6 - 0.25]
    torch.testing.assert_close(moved, torch.tensor(by_hand))


def test_driving_a_polygon_leads_home():
    state, turn = torch.tensor([3.0, -1.0, 0.4], dtype=torch.float64), 2 * math.pi / 12
    start = state
    for _ in range(12):
        state = dubins_step(state, torch.tensor([1.0, turn / 0.2], dtype=torch.float64), 0.2)
    torch.testing.assert_close(state, start)


def test_the_heading_stays_in_one_turn():
    states = torch.tensor([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]])
    moved = dubins_step(states, torch.tensor([[0.0, 1.0], [0.0, -1.0]]), 0.2)
    torch.testing.assert_close(moved[:, 2], torch.tensor([3.3 - math.tau, math.tau - 3.3]))


def test_its_noise_is_what_was_asked_for(transitions):
    model = Dubins(noise_std=0.01)
    state, action = transitions(5)
    mean, log_variance = model.moments(state, action)
    assert mean.shape == log_variance.shape == (5, 1, 3)
    assert torch.equal(log_variance, torch.zeros(5, 1, 3))
    change = model.manifold.difference(model(state, action), state)
    torch.testing.assert_close(mean.squeeze(-2) * 0.01, change)
    torch.testing.assert_close(model.standardise(change), change / 0.01)
    expected, noise = model.forecast(state, action)
    assert torch.equal(expected, model(state, action))
    assert torch.equal(noise, torch.full((5, 3), 0.01))
