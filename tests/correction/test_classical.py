"""Textbook correctors: least squares on the universal pairs, and L1 adaptive augmentation."""

import math
from functools import partial

import pytest
import torch

from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares
from afm_rl.correction.achievable import MODES
from afm_rl.correction.classical import low_pass, weigh
from afm_rl.correction.least_squares import fit_affine, fit_gain, fit_line
from afm_rl.dynamics import Quadrotor
from afm_rl.spaces.airframe import QuadrotorBody

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
DT, FAST = 0.2, 50.0  # s, rad/s
TURN = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
REGIMES = {
    "gain": lambda sent: torch.tensor([-0.8, 0.9]) * sent[-1],
    "gain_offset": lambda sent: torch.tensor([-0.8, 0.9]) * sent[-1] + 0.2,
    "affine": lambda sent: sent[-1] @ TURN.mT + 0.1,
}


def actions(*shape):
    return 2 * torch.rand(*shape, 2, generator=torch.Generator().manual_seed(1)) - 1


def test_weights_equal_plain_weighted_least_squares():
    u, seen = actions(9), actions(3, 9)[0]
    weights = 0.7 ** torch.arange(8.0, -1.0, -1.0)
    by_hand = (weights[:, None] * u * seen).sum(0) / (weights[:, None] * u**2).sum(0)
    assert torch.allclose(fit_gain(u, seen, weigh(torch.ones(9, 1), 0.7)), by_hand, atol=1e-2)


def test_without_evidence_the_fit_is_nominal():
    nothing = torch.zeros(24, 2), torch.zeros(24, 2), torch.zeros(24, 1)
    assert torch.allclose(fit_gain(*nothing), torch.ones(2))
    matrix, bias = fit_affine(*nothing)
    assert torch.allclose(matrix, torch.eye(2), atol=1e-5)
    assert torch.allclose(bias, torch.zeros(2), atol=1e-5)


@pytest.mark.parametrize("form", [fit_gain, fit_line, fit_affine])
def test_each_axis_has_weights_of_its_own(form):
    executed = actions(9)
    effective = torch.where(torch.arange(9).unsqueeze(-1) < 4, -executed, 0.5 * executed)
    first, last = (torch.arange(9) < 4).float(), (torch.arange(9) >= 4).float()
    gain = form(executed, effective, torch.stack([first, last], -1))
    gain = gain if form is fit_gain else gain[0]
    gain = gain.diagonal() if form is fit_affine else gain
    torch.testing.assert_close(gain, torch.tensor([-1.0, 0.5]), rtol=0, atol=0.01)


def test_one_outlier_does_not_move_the_robust_fit():
    executed = actions(12)
    effective = -0.7 * executed + 0.1
    effective[5] += 1.5
    gain, offset = fit_line(executed, effective, torch.ones(12, 1))
    torch.testing.assert_close(gain, torch.full((2,), -0.7), rtol=0, atol=0.06)
    torch.testing.assert_close(offset, torch.full((2,), 0.1), rtol=0, atol=0.06)


@pytest.mark.parametrize("form", REGIMES)
def test_the_corrected_action_has_the_planned_effect(line, drive, plans, form):
    corrector = LeastSquares(LOW, HIGH, form=form, forgetting=0.95)
    planned = plans(10, 5, 2, size=0.5)
    found, effects = drive(corrector, line(2), REGIMES[form], planned)
    assert found.corrected[1:].all()
    torch.testing.assert_close(effects[5:], planned[5:], rtol=0, atol=0.02)
    torch.testing.assert_close(found.predicted_effect[5:], effects[5:], rtol=0, atol=0.02)


def test_what_cannot_be_had_is_predicted_as_it_comes(line, drive, plans):
    corrector = LeastSquares(LOW, HIGH)
    planned = torch.cat([plans(6, 3, 2), HIGH.expand(1, 3, 2)])
    (_, executed, predicted, *_), effects = drive(corrector, line(2), REGIMES["gain"], planned)
    assert ((executed >= LOW) & (executed <= HIGH)).all()
    torch.testing.assert_close(predicted[-1], effects[-1], rtol=0, atol=0.02)


CORRECTORS = {form: partial(LeastSquares, LOW, HIGH, form=form) for form in REGIMES}
CORRECTORS["flow"] = partial(ActionFlow, LOW, HIGH)
CORRECTORS["L1"] = partial(L1Augmentation, LOW, HIGH, dt=DT)


@pytest.mark.parametrize("kind", CORRECTORS)
@pytest.mark.parametrize("saturation", MODES)
@pytest.mark.parametrize("gain", [0.01, 9.0])
def test_actions_stay_in_the_box(line, drive, plans, kind, saturation, gain):
    corrector = CORRECTORS[kind](saturation=saturation)
    found, _ = drive(corrector, line(2), lambda sent: gain * sent[-1], plans(6, 7, 2, size=1.0))
    executed, (low, high) = found.executed_action, found.effect_bounds.unbind(-2)
    assert ((executed >= LOW - 1e-6) & (executed <= HIGH + 1e-6)).all() and (low < high).all()


def test_the_filter_is_the_recursion_of_a_first_order_low_pass(plans):
    signal, here, keep = plans(3, 9, 2), torch.zeros(3, 2), math.exp(-5.0 * DT)
    for value in signal.unbind(-2):
        here = keep * here + (1 - keep) * value
    torch.testing.assert_close(low_pass(signal, torch.ones(3, 9, 1), 5.0, DT), here)


def test_ticks_that_do_not_count_are_taken_for_zero():
    valid = torch.tensor([0.0, 0.0, 1.0]).unsqueeze(-1)
    filtered = low_pass(torch.full((3, 1), 7.0), valid, 5.0, DT)
    assert filtered.item() == pytest.approx(7 * (1 - math.exp(-1.0)))


def test_without_a_disturbance_the_plan_is_executed(line, drive, plans):
    planned = plans(6, 5, 2)
    corrector = L1Augmentation(LOW, HIGH, dt=DT)
    found, _ = drive(corrector, line(2), lambda sent: sent[-1], planned)
    assert not found.corrected.any() and torch.equal(found.executed_action, planned)


def test_a_bias_is_taken_off(line, drive, plans):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=FAST)
    bias, planned = torch.tensor([0.2, -0.3]), plans(5, 2, 3, 2, size=0.5)
    found, effects = drive(corrector, line(2), lambda sent: sent[-1] + bias, planned)
    torch.testing.assert_close(effects[1:], planned[1:], atol=0.01, rtol=0)
    torch.testing.assert_close(found.predicted_effect[2:], effects[2:], atol=0.01, rtol=0)


def test_a_lost_mass_is_a_thrust_too_much(drive):
    low, high = torch.tensor([[-0.575, -3e-4, -3e-4, -1e-4], [0.575, 3e-4, 3e-4, 1e-4]])
    corrector = L1Augmentation(low, high, dt=0.05, bandwidth=200.0)
    level = torch.zeros(1, 13).index_fill(-1, torch.tensor(9), 1.0)
    hover = torch.tensor([QuadrotorBody().hover_thrust, 0.0, 0.0, 0.0])
    twice = torch.tensor([2.0, 1.0, 1.0, 1.0])
    planned = torch.stack([hover, 1.2 * hover]).unsqueeze(1)
    (_, executed, *_), _ = drive(corrector, Quadrotor(), lambda s: twice * s[-1], planned, level)
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
