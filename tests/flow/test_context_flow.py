"""The flow on a window of effective actions: what it reads, and what it is trained on."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import ContextFlow, Window, midpoint
from afm_rl.flow.saturation import LIMIT
from afm_rl.regimes import ActionGain


@pytest.fixture
def loud(box):
    """A flow that is never silent about a surprise."""
    views = ["recent", "late_1", "mean"]
    return ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, views=views)


def context_of(flow, window, last=None):
    return flow.context(window, Dubins(), last)


def grid(box):
    axis = torch.linspace(-0.8, 0.8, 5)
    unit = torch.cartesian_prod(axis, axis)
    return unit * (box[1] - box[0]) / 2


def test_a_reversed_motor_is_corrected_by_reversing_the_action(trained_flow, window_of, box):
    planned = grid(box)
    window = window_of([-1.0, 1.0], len(planned), rows=trained_flow.window)
    corrected = trained_flow.correct(context_of(trained_flow, window), None, planned).action
    right = planned * torch.tensor([-1.0, 1.0])
    miss = (corrected - right) / trained_flow.half_range
    assert miss.square().mean().sqrt() < 0.2
    reached = Dubins()(torch.zeros(len(planned), 3), corrected * torch.tensor([-1.0, 1.0]))
    wanted = Dubins()(torch.zeros(len(planned), 3), planned)
    uncorrected = Dubins()(torch.zeros(len(planned), 3), right)
    assert (reached - wanted).norm() < 0.3 * (uncorrected - wanted).norm()


def test_a_nominal_window_changes_little(trained_flow, window_of, box, told):
    planned = grid(box)
    context = context_of(trained_flow, window_of([1.0, 1.0], 25, rows=trained_flow.window))
    assert not context.misaligned.any() and not context.features.any()
    pairs = context.pairs[:, -trained_flow.shown :, :-1].flatten(-2)
    corrected = trained_flow.correct(told(trained_flow, pairs), None, planned).action
    miss = (corrected - planned) / trained_flow.half_range
    assert miss.square().mean().sqrt() < 0.2


def test_the_pairs_are_in_half_ranges(flow, window_of):
    window = window_of([2.0, -0.5], 3)
    pairs = context_of(flow, window).pairs
    assert pairs.shape == (3, flow.window, flow.pair_size)
    torch.testing.assert_close(pairs[..., :2], window.executed / flow.half_range)
    effective = window.executed * torch.tensor([2.0, -0.5]) / flow.half_range
    torch.testing.assert_close(pairs[..., 2:4], effective, rtol=0, atol=1e-3)
    assert (pairs[..., 4] == 1).all()
    expected = Dubins()(window.state, window.executed)
    error = Dubins().manifold.difference(window.next_state, expected).abs().amax(-1)
    torch.testing.assert_close(pairs[..., 5], error / 1e-3, rtol=1e-2, atol=0.1)


def test_the_context_is_what_was_read_in_each_view(box, window_of):
    flow = ContextFlow(*box, window=4, memory=9, views=["recent", "newest"], hidden=[16], latent=8)
    context = context_of(flow, window_of([2.0, -0.5], 3))
    recent, newest = context.features.unflatten(-1, (2, -1)).unbind(-2)
    rows = context.pairs[:, -4:, :-1].clone()
    for found, blank in ((recent, 2), (newest, 3)):
        rows[:, :blank] = 0.0
        expected = flow.read(rows.flatten(-2)).pack()
        torch.testing.assert_close(found, expected)


def test_the_executed_not_the_planned_action_is_judged(flow, window_of):
    window = window_of([-1.0, 1.0], 3)
    other = window._replace(planned=torch.randn(3, 9, 2))
    for found, expected in zip(context_of(flow, other), context_of(flow, window), strict=True):
        assert torch.equal(found, expected)


def test_missing_rows_are_blank_and_silent(loud, window_of):
    flow = loud
    window = window_of([-1.0, 1.0], 3)
    window.valid[:, :7] = False
    context = context_of(flow, window)
    assert (context.pairs[:, :7] == 0).all() and (context.pairs[:, 7:, 4] == 1).all()
    assert context.features.isfinite().all() and context.misaligned.all()
    window.valid[:] = False
    empty = context_of(flow, window)
    assert all((part == 0).all() for part in empty)


def test_one_surprise_among_the_newest_opens_the_gate(loud, window_of):
    flow = loud
    window = window_of([1.0, 1.0], 4)
    noise_std = 1e-3
    assert not context_of(flow, window).misaligned.any()
    window.next_state[1, -flow.shown, 0] += 1.01 * flow.gate * noise_std
    window.next_state[2, -1, 1] -= 0.95 * flow.gate * noise_std
    window.next_state[3, -flow.shown - 1, 0] += 9.0 * flow.gate * noise_std  # long ago
    context = context_of(flow, window)
    assert context.misaligned.tolist() == [False, True, False, False]
    expected = torch.tensor([0.0, 1.01, 0.95, 0.0]) * flow.gate
    torch.testing.assert_close(context.surprise, expected, rtol=0, atol=0.02)


@pytest.mark.parametrize("fault", [math.nan, math.inf, 1e38])
def test_faulty_rows_count_as_missing(box, window_of, fault):
    flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, place=[0, 1])
    window = window_of([-1.0, 1.0], 3)
    expected = context_of(flow, window)
    window.next_state[1, 7] = fault
    window.state[1, 8] = fault
    context = context_of(flow, window)
    assert all(part.isfinite().all() for part in context)
    assert torch.equal(context.features[[0, 2]], expected.features[[0, 2]])
    if not fault < math.inf:
        assert (context.pairs[1, 7:] == 0).all() and not context.evidence[1].any()


def test_outliers_are_clamped(flow, window_of):
    window = window_of([1.0, 1.0], 2)
    window.next_state[0, -1] += 1000.0
    context = context_of(flow, window)
    assert context.pairs[..., :-1].abs().max() == LIMIT
    assert context.features.isfinite().all()


def test_the_correction_integrates_the_velocity_from_every_source_point(flow, window_of, box, told):
    pairs = context_of(flow, window_of([-1.0, 1.0], 25)).pairs[:, -flow.shown :, :-1].flatten(-2)
    planned = grid(box)
    context = told(flow, pairs)
    corrected = flow.correct(context, None, planned)
    unit = planned / flow.half_range
    wide = unit.unsqueeze(-2).expand(-1, flow.samples, -1)
    known = flow.read(pairs.unsqueeze(-2))

    def velocity(tau, point):
        return flow(known, wide, torch.full_like(point[..., :1], tau), point)

    end = midpoint(velocity, wide + flow.source_std * flow.source_points, flow.steps)
    torch.testing.assert_close(corrected.spread, end.std(-2, correction=0) * flow.half_range)
    proposals = torch.cat([end.mean(-2, keepdim=True), end], -2).clamp(-1, 1) * flow.half_range
    apart = (proposals - corrected.action.unsqueeze(-2)).norm(dim=-1)
    assert (apart.amin(-1) < 1e-5).all()
    effect = flow.effect(known, (corrected.action / flow.half_range).unsqueeze(-2)).squeeze(-2)
    torch.testing.assert_close(corrected.expected, effect * flow.half_range)


def test_a_batch_equals_single_missions(flow, window_of, box):
    window, planned = window_of([-1.0, 1.0], 6), grid(box)[:6]
    context = context_of(flow, window)
    together = flow.correct(context, None, planned)
    for k in range(6):
        alone = context_of(flow, Window(*(part[k] for part in window)))
        torch.testing.assert_close(alone.features, context.features[k])
        single = flow.correct(alone, None, planned[k])
        for found, expected in zip(single, together, strict=True):
            torch.testing.assert_close(found, expected[k])


def test_source_points_cancel_and_a_point_source_has_no_spread(box, window_of):
    flow = ContextFlow(*box, window=4, hidden=[16], latent=8, samples=6)
    assert flow.source_points.shape == (6, 2)
    torch.testing.assert_close(flow.source_points.sum(0), torch.zeros(2))
    still = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, source_std=0.0)
    context = context_of(still, window_of([-1.0, 1.0], 25))
    spread = still.correct(context, None, grid(box)).spread
    torch.testing.assert_close(spread, torch.zeros(25, 2), rtol=0, atol=1e-6)


def test_examples_show_the_regime_its_inverse_and_its_effects(flow, states, box):
    twice = ActionGain(["v_gain", "omega_gain"], low=2.0, high=2.0, nominal=0.0)
    generator = torch.Generator().manual_seed(0)
    made = flow.examples(Dubins(), twice, states, 2000, generator)
    assert made.features.shape == (2000, flow.feature_size)
    rows = made.features.unflatten(-1, (4, 5))
    executed, effective, valid = rows[..., :2], rows[..., 2:4], rows[..., 4] > 0
    assert executed.abs().max() <= 1 and valid[:, -1].all()
    moving = executed[:, -1].abs() > 0.1
    gain = torch.where(moving, effective[:, -1] / executed[:, -1], 2.0)
    torch.testing.assert_close(gain.abs(), torch.full_like(gain, 2.0), rtol=0, atol=0.3)
    known, sign = moving.all(-1), 2.0 * gain.sign()
    torch.testing.assert_close(made.intended[known], (made.planned / sign)[known])
    torch.testing.assert_close(made.worth[known], (made.probe * sign)[known])
    for part in (made.intended, made.probe):
        assert (part >= box[0]).all() and (part <= box[1]).all()
    inside = ((made.planned >= box[0]) & (made.planned <= box[1])).all(-1)
    share = float(inside.float().mean())
    assert share == pytest.approx(0.5 + 0.5 / 4, abs=0.05)  # others ask for what can be had
    assert (made.planned.abs() <= 2 * box[1]).all()


def test_examples_straddle_changes_and_begin_with_missions(flow, states, gains):
    generator = torch.Generator().manual_seed(0)
    made = flow.examples(Dubins(), gains, states, 4000, generator)
    valid = made.features.unflatten(-1, (4, 5))[..., 4]
    assert (valid.diff(dim=-1) >= 0).all()  # what is missing is the oldest
    share = torch.bincount(valid.sum(-1).long(), minlength=5) / 4000
    # A quarter each: a sixth (one row), a half, all; and any number.
    expected = torch.tensor([0.0, 0.25 + 0.0625, 0.25 + 0.0625, 0.0625, 0.25 + 0.0625])
    torch.testing.assert_close(share, expected, rtol=0, atol=0.03)
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


def test_many_actions_are_no_trouble():
    flow = ContextFlow(-torch.ones(17), torch.ones(17), window=2, memory=5, hidden=[8], latent=4)
    assert flow.probes.shape == (35, 17) and flow.probes.abs().max() <= 1


@pytest.mark.parametrize(
    "settings",
    [
        {"window": 0},
        {"memory": 0},
        {"gate": -1.0},
        {"gate": math.nan},
        {"samples": 0},
        {"choose": "worst"},
        {"source_std": -0.1},
        {"steps": 0},
        {"saturation": "fold"},
        {"forgetting": 1.1},
        {"place_scale": 0.0},
        {"hidden": [0]},
        {"latent": 0},
        {"seed": 1.5},
        {"seed": None},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(box, settings):
    with pytest.raises(ConfigurationError, match=f"flow.{next(iter(settings))}"):
        ContextFlow(*box, **settings)
