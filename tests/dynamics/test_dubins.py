"""The nominal ground robot."""

import math

import torch

from afm_rl.dynamics import dubins_step


def test_a_step_by_hand():
    state, action = torch.tensor([1.0, 2.0, math.pi / 6]), torch.tensor([0.8, -0.5])
    moved = dubins_step(state, action, 0.5)
    by_hand = [1 + 0.4 * math.cos(math.pi / 6), 2 + 0.4 * 0.5, math.pi / 6 - 0.25]
    torch.testing.assert_close(moved, torch.tensor(by_hand))


def test_the_heading_stays_in_one_turn():
    states = torch.tensor([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]])
    moved = dubins_step(states, torch.tensor([[0.0, 1.0], [0.0, -1.0]]), 0.2)
    torch.testing.assert_close(moved[:, 2], torch.tensor([3.3 - math.tau, math.tau - 3.3]))
