import math

import pytest
import torch

from afm_rl.airframe import QuadrotorBody
from afm_rl.dynamics import Dubins, Quadrotor
from afm_rl.errors import ConfigurationError
from afm_rl.flow import L1Augmentation, Window
from afm_rl.flow.l1 import low_pass
from afm_rl.flow.saturation import MODES

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
DT, FAST = 0.2, 50.0  # s, rad/s


def actions(*shape):
    return 2 * torch.rand(*shape, 2, generator=torch.Generator().manual_seed(1)) - 1


def closed_loop(shown, corrector, regime, planned, ticks=40):
    """Execute one plan again and again; return the effect after each tick ``(T, A)``."""
    window, state, effects = corrector.window, torch.zeros(1, 3), []
    rows = torch.zeros(1, window, 2), torch.zeros(1, window, 2), torch.zeros(1, window).bool()
    for _ in range(ticks):
        executed = corrector.correct(shown(corrector, *rows), state, planned).action
        effect = regime(executed)
        effects.append(effect[0])
        newest = executed, effect, torch.ones(1).bool()
        rows = tuple(
            torch.cat([old[:, 1:], new.unsqueeze(1)], 1)
            for old, new in zip(rows, newest, strict=True)
        )
    return torch.stack(effects)


def test_the_filter_is_the_recursion_of_a_first_order_low_pass():
    signal, here, keep = actions(3, 9), torch.zeros(3, 2), math.exp(-5.0 * DT)
    for value in signal.unbind(-2):
        here = keep * here + (1 - keep) * value
    filtered = low_pass(signal, torch.ones(3, 9, 1), 5.0, DT)
    torch.testing.assert_close(filtered, here)


def test_a_constant_is_passed_up_to_what_the_window_forgets():
    filtered = low_pass(torch.ones(24, 1), torch.ones(24, 1), 5.0, 0.05)
    assert filtered.item() == pytest.approx(1 - math.exp(-24 * 5.0 * 0.05), abs=1e-6)


def test_ticks_that_do_not_count_are_taken_for_zero():
    valid = torch.tensor([0.0, 0.0, 1.0]).unsqueeze(-1)
    filtered = low_pass(torch.full((3, 1), 7.0), valid, 5.0, DT)
    assert filtered.item() == pytest.approx(7 * (1 - math.exp(-1.0)))


def test_without_a_disturbance_the_plan_is_executed(unknown):
    corrector, model = L1Augmentation(LOW, HIGH, dt=DT), Dubins()
    state, executed = torch.zeros(5, 24, 3), actions(5, 24) * HIGH
    rows = Window(state, executed, executed, model(state, executed), torch.ones(5, 24).bool())
    context = corrector.context(rows, model, unknown(corrector, 5))
    assert not context.misaligned.any()
    planned = 0.5 * actions(5) * HIGH
    corrected = corrector.correct(context, state[:, 0], planned)
    torch.testing.assert_close(corrected.action, planned, atol=1e-4, rtol=0)
    assert not corrected.spread.any() and corrected.reach is None


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_a_bias_is_taken_off(unknown, batch):
    bias, model = torch.tensor([0.2, -0.3]), Dubins()
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=FAST)
    state, executed = torch.zeros(*batch, 24, 3), 0.5 * actions(*batch, 24) * HIGH
    seen = model(state, executed + bias)
    rows = Window(state, executed, executed, seen, torch.ones(*batch, 24).bool())
    context = corrector.context(rows, model, unknown(corrector, *batch))
    assert context.misaligned.all()
    planned = 0.5 * actions(*batch) * HIGH
    corrected = corrector.correct(context, state[..., 0, :], planned).action
    torch.testing.assert_close(corrected + bias, planned, atol=0.01, rtol=0)


def test_a_lost_mass_is_a_thrust_too_much():
    low, high = torch.tensor([[-0.575, -3e-4, -3e-4, -1e-4], [0.575, 3e-4, 3e-4, 1e-4]])
    corrector, model = L1Augmentation(low, high, dt=0.05, bandwidth=200.0), Quadrotor()
    level = torch.zeros(1, 24, 13).index_fill(-1, torch.tensor(9), 1.0)
    hover = torch.tensor([QuadrotorBody().hover_thrust, 0.0, 0.0, 0.0]).expand(1, 24, 4)
    twice = hover * torch.tensor([2.0, 1.0, 1.0, 1.0])
    rows = Window(level, hover, hover, model(level, twice), torch.ones(1, 24).bool())
    context = corrector.context(rows, model)
    planned = hover[:, 0] * torch.tensor([1.2, 1.0, 1.0, 1.0])
    corrected = corrector.correct(context, level[:, 0], planned).action
    torch.testing.assert_close(corrected, planned - (twice - hover)[:, 0], atol=1e-4, rtol=0)


def test_a_disturbance_fades_at_the_bandwidth(shown):
    corrector, planned = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=2.0), torch.zeros(1, 2)
    bias = torch.tensor([0.4, 0.3])
    effects = closed_loop(shown, corrector, lambda action: action + bias, planned, 6)
    expected = bias * torch.exp(-2.0 * DT * torch.arange(6.0)).unsqueeze(-1)
    torch.testing.assert_close(effects, expected)


@pytest.mark.parametrize(("gain", "settles"), [(0.5, True), (3.0, True), (3.5, False), (-1, False)])
def test_a_gain_is_countered_within_the_limit_that_is_promised(shown, gain, settles):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, bandwidth=5.0)  # limit: 2 / (1 - 1/e) = 3.16
    planned = torch.tensor([[0.2, 0.3]])
    effects = closed_loop(shown, corrector, lambda action: gain * action, planned, 60)
    assert torch.allclose(effects[-1], planned[0], atol=0.02) == settles


@pytest.mark.parametrize("saturation", MODES)
def test_actions_stay_in_the_box(shown, saturation):
    corrector = L1Augmentation(LOW, HIGH, dt=DT, saturation=saturation)
    context = shown(corrector, actions(7, 24), 9 * actions(7, 24))
    corrected = corrector.correct(context, torch.zeros(7, 3), HIGH.expand(7, 2)).action
    assert ((corrected >= LOW - 1e-6) & (corrected <= HIGH + 1e-6)).all()


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        ({"dt": 0.0}, "flow.dt"),
        ({"bandwidth": 0.0}, "corrector.bandwidth"),
        ({"bandwidth": math.inf}, "corrector.bandwidth"),
        ({"window": 0}, "corrector.window"),
        ({"gate": -1.0}, "corrector.gate"),
        ({"saturation": "none"}, "corrector.saturation"),
    ],
)
def test_bad_settings_are_refused(setting, name):
    with pytest.raises(ConfigurationError, match=name):
        L1Augmentation(LOW, HIGH, **{"dt": DT, **setting})
