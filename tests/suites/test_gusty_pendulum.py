"""OMAC's pendulum: what is known of it, and what is not."""

import math

import pytest
import torch
from gusts.pendulum import DAMPING, GRAVITY, Gusts, believed, gusty_pendulum_task, steer, winds


def test_the_controller_brings_the_believed_pendulum_upright():
    state = torch.tensor([math.pi / 4, 0.0])
    for _ in range(1000):
        state = believed(state, steer(state))
    assert state.abs().max() < 1e-3


def test_without_wind_the_effect_is_that_of_true_gravity_and_damping():
    angle, speed = 0.3, 0.7
    still = Gusts().encode({"outside": 1.0})
    state = torch.tensor([angle, speed], dtype=torch.float64)
    effect = Gusts().apply(torch.zeros(1), still, state)
    drag = -0.5 * 0.5 * (0.5 * speed) ** 2  # l times 0.5 v^2
    moved = believed(state, effect)[1].item()
    wanted = 0.5 * GRAVITY * math.sin(angle) - DAMPING * speed + drag
    assert moved == pytest.approx(speed + 0.01 / 0.25 * wanted, abs=1e-6)


def test_wind_pushes_only_across_the_pendulum():
    row = Gusts().encode({"outside": 1.0, "gust_x": 2.0})
    upright = torch.zeros(2)
    assert Gusts().apply(torch.zeros(1), row, upright).item() == pytest.approx(0.5 * 0.5 * 4)
    lying = torch.tensor([math.pi / 2, 0.0])
    gravity = 0.5 * (GRAVITY - 9.0)
    assert Gusts().apply(torch.zeros(1), row, lying).item() == pytest.approx(gravity, abs=1e-6)


def test_the_told_controller_undoes_the_mean_of_it():
    row, state = Gusts().encode(winds(3, 1)[0]), torch.tensor([0.4, -1.0])
    low, high = torch.tensor([-20.0]), torch.tensor([20.0])
    torque = Gusts().inverse(steer(state), row, state, low, high)
    torch.testing.assert_close(Gusts().apply(torque, row, state), steer(state))
    shaken = Gusts().apply(torque, row, state, noise=torch.ones(1))
    torch.testing.assert_close(shaken - steer(state), torch.tensor([0.1]))


def test_gusts_are_drawn_anew_and_episodes_begin_within_a_quarter_turn():
    task = gusty_pendulum_task()
    gusts = [gust["gust_x"] for row in task.contexts["gusts"] for gust in row]
    assert len(set(gusts)) == 300
    assert torch.tensor(gusts).std() == pytest.approx(1.0, abs=0.1)
    starts = torch.stack([task.start(seed)[0][0] for seed in range(50)])
    assert 0.7 < starts.abs().max() <= math.pi / 4
