"""L1 adaptive augmentation: what it promises, and where it ends."""

import math

import pytest
import torch

from afm_rl.correction import L1Augmentation
from afm_rl.correction.achievable import MODES
from afm_rl.correction.classical import low_pass
from afm_rl.dynamics import Quadrotor
from afm_rl.spaces.airframe import QuadrotorBody

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
DT, FAST = 0.2, 50.0  # s, rad/s


def test_the_filter_is_the_recursion_of_a_first_order_low_pass(plans):
    signal, here, keep = plans(3, 9, 2), torch.zeros(3, 2), math.exp(-5.0 * DT)
    for value in signal.unbind(-2):
        here = keep * here + (1 - keep) * value
    torch.testing.assert_close(low_pass(signal, torch.ones(3, 9, 1), 5.0, DT), here)


def test_a_constant_is_passed_up_to_what_the_window_forgets():
    filtered = low_pass(torch.ones(24, 1), torch.ones(24, 1), 5.0, 0.05)
    assert filtered.item() == pytest.approx(1 - math.exp(-24 * 5.0 * 0.05), abs=1e-6)


def test_ticks_that_do_not_count_are_taken_for_zero():
    valid = torch.tensor([0.0, 0.0, 1.0]).unsqueeze(-1)
    filtered = low_pass(torch.full((3, 1), 7.0), valid, 5.0, DT)
    assert filtered.item() == pytest.approx(7 * (1 - math.exp(-1.0)))


def test_without_a_disturbance_the_plan_is_executed(line, drive, plans):
    planned = plans(6, 5, 2)
    (executed, *_, misaligned), _ = drive(
        L1Augmentation(LOW, HIGH, dt=DT), line(2), lambda sent: sent[-1], planned
    )
    assert not misaligned.any() and torch.equal(executed, planned)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
def test_a_bias_is_taken_off(line, drive, plans, batch):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=FAST)
    bias, planned = torch.tensor([0.2, -0.3]), plans(5, *batch, 2, size=0.5)
    (executed, predicted, spread, bounds, *_), effects = drive(
        corrector, line(2), lambda sent: sent[-1] + bias, planned
    )
    torch.testing.assert_close(effects[1:], planned[1:], atol=0.01, rtol=0)
    torch.testing.assert_close(predicted[2:], effects[2:], atol=0.01, rtol=0)
    assert not spread.any()


def test_a_lost_mass_is_a_thrust_too_much(drive):
    low, high = torch.tensor([[-0.575, -3e-4, -3e-4, -1e-4], [0.575, 3e-4, 3e-4, 1e-4]])
    corrector = L1Augmentation(low, high, dt=0.05, bandwidth=200.0)
    level = torch.zeros(1, 13).index_fill(-1, torch.tensor(9), 1.0)
    hover = torch.tensor([QuadrotorBody().hover_thrust, 0.0, 0.0, 0.0])
    twice = torch.tensor([2.0, 1.0, 1.0, 1.0])
    planned = torch.stack([hover, 1.2 * hover]).unsqueeze(1)
    (executed, *_), _ = drive(corrector, Quadrotor(), lambda s: twice * s[-1], planned, level)
    torch.testing.assert_close(executed[1], planned[1] - hover, atol=1e-3, rtol=0)


def test_a_disturbance_fades_at_the_bandwidth(line, drive):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=2.0)
    bias, planned = torch.tensor([0.4, 0.3]), torch.zeros(6, 1, 2)
    _, effects = drive(corrector, line(2, 1e-6), lambda sent: sent[-1] + bias, planned)
    expected = bias * torch.exp(-2.0 * DT * torch.arange(6.0)).unsqueeze(-1)
    torch.testing.assert_close(effects[:, 0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("gain", "settles"), [(0.5, True), (3.0, True), (3.5, False), (-1, False)])
def test_a_gain_is_countered_within_the_limit_that_is_promised(line, drive, gain, settles):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=5.0)  # limit: 2 / (1 - 1/e) = 3.16
    planned = torch.tensor([0.2, 0.3]).expand(60, 1, 2)
    _, effects = drive(corrector, line(2), lambda sent: gain * sent[-1], planned)
    assert torch.allclose(effects[-1], planned[-1], atol=0.02) == settles


@pytest.mark.parametrize("saturation", MODES)
def test_actions_stay_in_the_box(line, drive, plans, saturation):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, saturation=saturation)
    (executed, *_), _ = drive(corrector, line(2), lambda sent: 9 * sent[-1], plans(6, 7, 2))
    assert ((executed >= LOW - 1e-6) & (executed <= HIGH + 1e-6)).all()
