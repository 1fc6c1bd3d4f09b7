"""Least-squares experts against closed forms."""

import pytest
import torch
from test_axis_network import drawn

from afm_rl.correction.achievable import MODES
from afm_rl.correction.classical import weigh
from afm_rl.correction.experts import (
    ANSWERS,
    LIMIT,
    LONG,
    MISSES,
    NEAR,
    SHORT,
    Rows,
    confidence,
    fit_experts,
)
from afm_rl.correction.least_squares import fit_affine, fit_gain, fit_line, not_zero

AXIS = torch.linspace(-1, 1, 5)
ASKED = torch.cartesian_prod(AXIS, AXIS).unsqueeze(0)
EXECUTED = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7], [0.4, 0.9], [0.6, -1]])
NEAREST = 3  # place of the answer
MAPS = {
    "gain": (lambda u: torch.tensor([-1.6, 1.3]) * u, range(3)),
    "gain and offset": (lambda u: torch.tensor([-1.6, 1.3]) * u + 0.2, (2,)),
    "small gain": (lambda u: torch.tensor([0.05, -0.3]) * u, (0, 1, 2)),
}


def rows_of(executed, effective, std=0.0, valid=None):
    """Return one set of rows, ``(1, K, A)``."""
    std = torch.as_tensor(std).expand_as(executed)
    valid = torch.ones_like(executed[:, :1]) if valid is None else valid
    return Rows(*(part.unsqueeze(0) for part in (executed, effective, std, valid)))


def answers(found):
    """Return answers ``(1, A, C, E)`` as ``(C, E, A)``."""
    return found[0].permute(1, 2, 0)


@pytest.fixture(params=MAPS)
def example(request):
    """A map, the experts' fits of it, and which of them are exact."""
    regime, exact = MAPS[request.param]
    return regime, fit_experts(rows_of(EXECUTED, regime(EXECUTED))), exact


def test_effects_are_exact_where_a_fit_can_express_them(example):
    regime, experts, exact = example
    found = answers(experts.effect(ASKED))
    assert found.shape == (25, ANSWERS, 2)
    for k in exact:
        assert (found[:, k] - regime(ASKED[0])).abs().max() < 0.02


def test_actions_are_exact_where_a_fit_can_express_them(example):
    regime, experts, exact = example
    inside = 0.99 * ASKED[0][(ASKED[0] != 0).all(-1)]
    planned = regime(inside)
    planned = planned[(planned.abs() > 0.01).all(-1)]
    found = answers(experts.execute(planned.unsqueeze(0), "clip"))
    for k in exact:
        assert found[:, k].abs().max() <= 1
        torch.testing.assert_close(regime(found[:, k]), planned, rtol=0.03, atol=0.05)


def test_nearness_counts_no_more_than_one_pair():
    executed = torch.tensor([[0.5], [0.5], [0.5], [-0.5]])
    experts = fit_experts(rows_of(executed, executed))
    found = answers(experts.effect(torch.tensor([[[0.5], [0.5 + NEAR], [3.0]]])))[:, NEAREST + 1, 0]
    at, beside = found[:2].tolist()
    assert at == 1.0 and 0.5 < beside < 1.0 and found[2] < 1e-6


def test_each_explains_what_it_can_express(example):
    _, experts, exact = example
    misses = experts.misses[0, :, 0].mean(0)
    assert misses.shape == (MISSES,) and misses.argmin().item() in exact
    assert (misses[list(exact)] < -3.5).all()
    assert (experts.residuals[..., list(exact)].abs() < 0.05).all()


def test_the_fits_are_those_of_the_single_functions():
    executed, effective = drawn(5, 12, 3), 2 * drawn(5, 12, 3, seed=1)
    std, valid = 0.3 * drawn(5, 12, 3, seed=2).abs(), (drawn(5, 12, 1, seed=3) > -0.5).double()
    rows = Rows(executed.double(), effective.double(), std.double(), valid)
    short, long = (weigh(valid, forgetting) * confidence(rows.std) for forgetting in (SHORT, LONG))
    experts, pairs = fit_experts(rows), rows[:2]
    gain, offset = experts.gain.squeeze(-2), experts.offset.squeeze(-2)
    one_by_one = [
        (gain[..., 0], not_zero(fit_gain(*pairs, short)[0])),
        (gain[..., 1], not_zero(fit_gain(*pairs, long)[0])),
        *zip((gain[..., 2], offset[..., 2]), fit_line(*pairs, long, rounds=1), strict=True),
    ]
    for found, expected in one_by_one:
        torch.testing.assert_close(found, expected)
    assert (offset[..., :2].abs() < 1e-9).all()


@pytest.mark.parametrize("form", [fit_gain, fit_line, fit_affine])
def test_each_axis_has_weights_of_its_own(form):
    executed = drawn(9, 2)
    effective = torch.where(torch.arange(9).unsqueeze(-1) < 4, -executed, 0.5 * executed)
    first, last = (torch.arange(9) < 4).float(), (torch.arange(9) >= 4).float()
    gain = form(executed, effective, torch.stack([first, last], -1))[0]
    gain = gain.diagonal() if form is fit_affine else gain
    torch.testing.assert_close(gain, torch.tensor([-1.0, 0.5]), rtol=0, atol=0.01)


@pytest.mark.parametrize("std", [4.0, 100.0])
def test_a_pair_that_shows_nothing_hardly_counts(std):
    effective, noise = -EXECUTED, torch.zeros_like(EXECUTED)
    wrong = effective.clone()
    wrong[-1], noise[-1] = 3.0, std
    asked = torch.tensor([[[0.3, 0.4]]])
    expected = fit_experts(rows_of(EXECUTED, effective)).effect(asked)
    found = fit_experts(rows_of(EXECUTED, wrong, noise)).effect(asked)
    torch.testing.assert_close(found[..., :MISSES], expected[..., :MISSES], rtol=0, atol=0.03)
    silenced = fit_experts(rows_of(EXECUTED, wrong)).effect(asked)
    assert (silenced[..., :2] - expected[..., :2]).abs().min() > 0.2


def test_rows_that_are_not_valid_do_not_count_at_all():
    valid = torch.ones(len(EXECUTED), 1)
    valid[0] = 0.0
    wrong = EXECUTED.clone()
    wrong[0] = -3.0
    found, expected = (
        fit_experts(rows_of(u, 2 * EXECUTED, valid=valid)).effect(ASKED) for u in (wrong, EXECUTED)
    )
    torch.testing.assert_close(found[..., :MISSES], expected[..., :MISSES], rtol=0, atol=1e-4)


def test_one_outlier_does_not_move_the_robust_fit():
    executed = drawn(12, 1)
    effective = -0.7 * executed + 0.1
    effective[5] += 1.5
    gain, offset = fit_line(executed, effective, torch.ones(12, 1))
    torch.testing.assert_close(gain, torch.tensor([-0.7]), rtol=0, atol=0.06)
    torch.testing.assert_close(offset, torch.tensor([0.1]), rtol=0, atol=0.06)


@pytest.mark.parametrize("mode", MODES)
def test_what_cannot_be_had_gives_way_by_the_mode(mode):
    experts = fit_experts(rows_of(EXECUTED, 0.06 * EXECUTED))
    found = answers(experts.execute(torch.tensor([[[0.8, 0.4]]]), mode))[0]
    expected = torch.tensor([1.0, 1.0] if mode == "clip" else [1.0, 0.5])
    torch.testing.assert_close(found[:2], expected.expand(2, 2), rtol=0, atol=0.03)


def test_the_nearest_pairs_answer_what_no_fit_can():
    executed = torch.linspace(-1, 1, 9).unsqueeze(-1)
    effective = executed.abs() * (1 - executed.abs())  # two actions for each effect
    experts = fit_experts(rows_of(executed, effective))
    asked = executed[[0, 3, 6]]
    found = answers(experts.effect(asked.unsqueeze(0)))
    torch.testing.assert_close(found[:, NEAREST], effective[[0, 3, 6]], rtol=0, atol=0.04)
    assert (found[:, NEAREST + 1] > 0.3).all()
    found = answers(experts.execute(effective[[0, 6]].unsqueeze(0), "clip"))
    torch.testing.assert_close(found[:, NEAREST + 1], effective[[0, 6]], rtol=0, atol=0.1)
    assert found[:, NEAREST].abs().max() <= 1


def test_near_is_near_on_each_axis_for_itself():
    executed = torch.tensor([[0.8, -0.8], [-0.8, 0.8]])
    experts = fit_experts(rows_of(executed, torch.tensor([[0.1, 0.2], [0.3, 0.4]])))

    def at(x):
        return answers(experts.effect(torch.tensor([[[x, 0.8]]])))[0, NEAREST:]

    effect, nearness = at(0.8)
    torch.testing.assert_close(effect, torch.tensor([0.1, 0.4]), rtol=0, atol=1e-4)
    assert (nearness > 0.89).all()
    close, further, far = (float(at(x)[1, 0]) for x in (0.7, 0.8 - NEAR, 0.0))
    assert 0.9 > close > further > far and far < 1e-5
    assert further == pytest.approx(0.9 / 2.718, abs=1e-3)  # of the older one, at one length


def test_the_newer_of_two_equals_counts_more():
    executed = torch.full((2, 1), 0.5)
    experts = fit_experts(rows_of(executed, torch.tensor([[0.0], [1.0]])))
    found = answers(experts.effect(torch.tensor([[[0.5]]])))[0, NEAREST]
    assert float(found) == pytest.approx(1 / 1.9, abs=1e-3)


@pytest.mark.parametrize("axes", [1, 2, 17])
def test_without_rows_the_plan_is_believed(axes):
    nothing = torch.zeros(6, axes)
    experts = fit_experts(rows_of(nothing, nothing, valid=torch.zeros(6, 1)))
    asked = drawn(1, 4, axes)
    for found in (experts.execute(asked, "direction"), experts.effect(asked)):
        believed = answers(found)[:, :MISSES]
        expected = asked[0].unsqueeze(-2).expand_as(believed)
        torch.testing.assert_close(believed, expected, rtol=0, atol=2e-3)
    assert (answers(experts.effect(asked))[:, -1] < 1e-4).all()  # nothing is near


def test_effects_are_cut_where_they_carry_no_news():
    experts = fit_experts(rows_of(0.01 * EXECUTED, 4 * EXECUTED))
    assert experts.effect(torch.ones(1, 1, 2)).abs().max() == LIMIT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fits_are_made_in_double_precision_and_answers_are_not(dtype):
    experts = fit_experts(Rows(*(part.to(dtype) for part in rows_of(EXECUTED, -EXECUTED))))
    assert all(part.dtype is dtype for part in experts)
    asked = torch.zeros(1, 7, 2, dtype=dtype)
    for found in (experts.effect(asked), experts.execute(asked, "mixed")):
        assert found.shape == (1, 2, 7, ANSWERS) and found.dtype is dtype
