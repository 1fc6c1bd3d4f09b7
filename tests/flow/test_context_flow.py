"""The flow on a window of effective actions."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import Context, ContextFlow, Window, midpoint
from afm_rl.flow.pairs import LIMIT
from afm_rl.regimes import ActionGain

SILENT = Context(torch.zeros(1), torch.zeros(1), torch.zeros(1, dtype=torch.bool))


@pytest.fixture
def flow(box):
    return ContextFlow(*box, window=4, hidden=[16], latent=8)


@pytest.fixture
def window_of(transitions):
    """Make a full window of transitions under a gain."""

    def make(gain, *batch, rows=4):
        state, action = transitions(*batch, rows)
        reached = Dubins()(state, action * torch.tensor(gain))
        valid = torch.ones(*batch, rows, dtype=torch.bool)
        return Window(state, action, action, reached, valid)

    return make


def context_of(flow, window):
    return flow.context(window, Dubins(), SILENT)


def grid(box):
    axis = torch.linspace(-0.8, 0.8, 5)
    unit = torch.cartesian_prod(axis, axis)
    return unit * (box[1] - box[0]) / 2


def test_a_reversed_motor_is_corrected_by_reversing_the_action(trained_flow, window_of, box):
    planned = grid(box)
    window = window_of([-1.0, 1.0], len(planned))
    corrected, _ = trained_flow.correct(context_of(trained_flow, window), None, planned)
    right = planned * torch.tensor([-1.0, 1.0])
    miss = (corrected - right) / trained_flow.half_range
    assert miss.square().mean().sqrt() < 0.2
    reached = Dubins()(torch.zeros(len(planned), 3), corrected * torch.tensor([-1.0, 1.0]))
    wanted = Dubins()(torch.zeros(len(planned), 3), planned)
    uncorrected = Dubins()(torch.zeros(len(planned), 3), right)
    assert (reached - wanted).norm() < 0.3 * (uncorrected - wanted).norm()


def test_a_nominal_window_changes_little(trained_flow, window_of, box):
    planned = grid(box)
    context = context_of(trained_flow, window_of([1.0, 1.0], len(planned)))
    assert not context.misaligned.any()
    corrected, _ = trained_flow.correct(context, None, planned)
    miss = (corrected - planned) / trained_flow.half_range
    assert miss.square().mean().sqrt() < 0.2


def test_the_context_holds_pairs_in_half_ranges(flow, window_of):
    window = window_of([2.0, -0.5], 3)
    features = context_of(flow, window).features.unflatten(-1, (4, 5))
    torch.testing.assert_close(features[..., :2], window.executed / flow.half_range)
    effective = window.executed * torch.tensor([2.0, -0.5]) / flow.half_range
    torch.testing.assert_close(features[..., 2:4], effective, rtol=0, atol=1e-3)
    assert (features[..., 4] == 1).all()


def test_the_executed_not_the_planned_action_is_judged(flow, window_of):
    window = window_of([-1.0, 1.0], 3)
    other = window._replace(planned=torch.randn(3, 4, 2))
    assert torch.equal(context_of(flow, other).features, context_of(flow, window).features)


def test_missing_rows_are_blank_and_silent(flow, window_of):
    window = window_of([-1.0, 1.0], 3)
    window.valid[:, :2] = False
    context = context_of(flow, window)
    features = context.features.unflatten(-1, (4, 5))
    assert (features[:, :2] == 0).all() and (features[:, 2:, 4] == 1).all()
    window.valid[:] = False
    empty = context_of(flow, window)
    assert (empty.features == 0).all() and (empty.surprise == 0).all()
    assert not empty.misaligned.any()


def test_one_surprise_in_the_window_opens_the_gate(flow, window_of):
    window = window_of([1.0, 1.0], 3)
    noise_std = 1e-3
    assert not context_of(flow, window).misaligned.any()
    window.next_state[1, 0, 0] += 1.01 * flow.gate * noise_std
    window.next_state[2, 3, 1] -= 0.95 * flow.gate * noise_std
    context = context_of(flow, window)
    assert context.misaligned.tolist() == [False, True, False]
    expected = torch.tensor([0.0, 1.01, 0.95]) * flow.gate
    torch.testing.assert_close(context.surprise, expected, rtol=0, atol=0.02)


@pytest.mark.parametrize("fault", [math.nan, math.inf, 1e38])
def test_faulty_rows_count_as_missing(flow, window_of, fault):
    window = window_of([-1.0, 1.0], 3)
    expected = context_of(flow, window)
    window.next_state[1, 2] = fault
    context = context_of(flow, window)
    assert context.features.isfinite().all() and context.surprise.isfinite().all()
    assert torch.equal(context.features[[0, 2]], expected.features[[0, 2]])
    if not fault < math.inf:
        assert (context.features.unflatten(-1, (4, 5))[1, 2] == 0).all()


def test_outliers_are_clamped(flow, window_of):
    window = window_of([1.0, 1.0], 2)
    window.next_state[0, 0] += 1000.0
    features = context_of(flow, window).features
    assert features.abs().max() == LIMIT


def test_the_correction_integrates_the_velocity_from_every_source_point(flow, window_of, box):
    context = context_of(flow, window_of([-1.0, 1.0], 25))
    planned = grid(box)
    corrected, spread = flow.correct(context, None, planned)
    unit = (planned / flow.half_range).unsqueeze(-2).expand(-1, flow.samples, -1)
    features = context.features.unsqueeze(-2).expand(-1, flow.samples, -1)

    def velocity(tau, point):
        return flow(features, unit, torch.full_like(point[..., :1], tau), point)

    start = unit + flow.source_std * flow.source_points
    end = midpoint(velocity, start, flow.steps)
    torch.testing.assert_close(corrected, end.mean(-2) * flow.half_range)
    torch.testing.assert_close(spread, end.std(-2, correction=0) * flow.half_range)


def test_a_batch_equals_single_missions(flow, window_of, box):
    window, planned = window_of([-1.0, 1.0], 6), grid(box)[:6]
    context = context_of(flow, window)
    corrected, spread = flow.correct(context, None, planned)
    for k in range(6):
        alone = context_of(flow, Window(*(part[k] for part in window)))
        torch.testing.assert_close(alone.features, context.features[k])
        single = flow.correct(alone, None, planned[k])
        torch.testing.assert_close(single, (corrected[k], spread[k]))


def test_source_points_cancel_and_a_point_source_has_no_spread(box, window_of):
    flow = ContextFlow(*box, window=4, hidden=[16], latent=8, samples=6)
    assert flow.source_points.shape == (6, 2)
    torch.testing.assert_close(flow.source_points.sum(0), torch.zeros(2))
    still = ContextFlow(*box, window=4, hidden=[16], latent=8, source_std=0.0)
    _, spread = still.correct(context_of(still, window_of([1.0, 1.0], 25)), None, grid(box))
    torch.testing.assert_close(spread, torch.zeros(25, 2), rtol=0, atol=1e-6)


def test_examples_show_the_regime_and_its_inverse(flow, states, box):
    twice = ActionGain(["v_gain", "omega_gain"], low=2.0, high=2.0, nominal=0.0)
    generator = torch.Generator().manual_seed(0)
    made = flow.examples(Dubins(), twice, states, 500, generator)
    assert made.features.shape == (500, flow.feature_size)
    rows = made.features.unflatten(-1, (4, 5))
    executed, effective, valid = rows[..., :2], rows[..., 2:4], rows[..., 4] > 0
    assert executed.abs().max() <= 1 and valid[:, -1].all()
    assert (made.planned >= box[0]).all() and (made.planned <= box[1]).all()
    moving = executed[:, -1].abs() > 0.1
    gain = torch.where(moving, effective[:, -1] / executed[:, -1], 2.0)
    torch.testing.assert_close(gain.abs(), torch.full_like(gain, 2.0), rtol=0, atol=0.3)
    known = moving.all(-1)
    expected = made.planned / (2.0 * gain.sign())
    torch.testing.assert_close(made.intended[known], expected[known])


def test_examples_straddle_changes_and_begin_with_missions(flow, states, gains):
    generator = torch.Generator().manual_seed(0)
    made = flow.examples(Dubins(), gains, states, 4000, generator)
    valid = made.features.unflatten(-1, (4, 5))[..., 4]
    assert (valid.diff(dim=-1) >= 0).all()  # what is missing is the oldest
    short = float((valid.sum(-1) < 4).float().mean())
    assert 0.03 < short < 0.1
    rows = made.features.unflatten(-1, (4, 5))
    gain = (rows[..., 2:4] / rows[..., :2]).where(rows[..., :2].abs() > 0.2, torch.nan)
    steady = (gain.amax(1) - gain.amin(1)).abs() < 0.2
    sure = gain.isfinite().all(1)
    share = float(steady[sure].float().mean())
    assert 0.4 < share < 0.8  # half of the windows, and some that change little


def test_initial_weights_follow_the_seed_alone(box):
    settings = {"window": 3, "hidden": [8], "latent": 4}
    before = torch.get_rng_state()
    first, again = (ContextFlow(*box, **settings) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    other = ContextFlow(*box, seed=1, **settings)
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
        assert not torch.equal(value, other.state_dict()[name])


@pytest.mark.parametrize(
    "settings",
    [
        {"window": 0},
        {"gate": -1.0},
        {"gate": math.nan},
        {"samples": 0},
        {"source_std": -0.1},
        {"steps": 0},
        {"saturation": "fold"},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(box, settings):
    with pytest.raises(ConfigurationError, match=f"flow.{next(iter(settings))}"):
        ContextFlow(*box, **settings)
