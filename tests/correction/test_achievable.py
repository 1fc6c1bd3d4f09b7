"""Actions that cannot be had in full."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.correction.achievable import (
    MODES,
    ROUNDS,
    TOLERANCE,
    attainable,
    extend,
    intend,
    saturate,
)

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])


@given(st.lists(st.floats(-10, 10), min_size=2, max_size=2))
def test_all_modes_end_in_the_box_and_keep_what_fits(values):
    unit = torch.tensor(values, dtype=torch.float64)
    for mode in MODES:
        result = saturate(unit, mode)
        assert result.abs().max() <= 1 + 1e-12
        if unit.abs().max() <= 1:
            assert torch.equal(result, unit)


def test_one_mode_keeps_the_direction_the_other_the_components():
    unit = torch.tensor([[0.5, -2.0], [4.0, 2.0]])
    assert saturate(unit, "clip").tolist() == [[0.5, -1.0], [1.0, 1.0]]
    assert saturate(unit, "direction").tolist() == [[0.25, -1.0], [1.0, 0.5]]


def test_the_third_clips_what_can_be_had_to_fifteen_percent():
    unit = torch.tensor([[1.0, 6.6], [1.0, 12.5], [-24.0, 12.0]])
    slower = [[1 / 12.5, 1.0], [-1.0, 0.5]]
    expected = torch.tensor([[1.0, 1.0], *slower])
    torch.testing.assert_close(saturate(unit, "mixed"), expected)


@pytest.mark.parametrize(
    ("mode", "share"),
    [("clip", (1, 1, 1, 1)), ("direction", (1, 0.5, 0.08, 0)), ("mixed", (1, 1, 0.08, 0))],
)
def test_of_a_plan_the_part_is_asked_for_that_can_be_had(mode, share):
    unit = torch.tensor([[0.8, -0.5], [0.8, -0.5], [0.8, -0.5], [0.8, 0.0]])
    low = torch.tensor([[-1.0, -0.5], [-1.0, -0.25], [-1.0, -0.04], [-1.0, -1.0]])
    high = torch.tensor([[2.0, 2.0], [0.9, 2.0], [0.9, 2.0], [-0.1, 2.0]])  # it cannot go there
    expected = torch.tensor(share).unsqueeze(-1) * unit
    torch.testing.assert_close(attainable(unit, low, high, mode), expected)


def test_where_nothing_can_be_had_the_others_are_no_slower():
    unit, high = torch.tensor([0.8, 0.5]), torch.tensor([0.4, 0.01])
    torch.testing.assert_close(attainable(unit, -high, high, "direction"), 0.5 * unit)


@pytest.mark.parametrize(
    ("share", "tried", "bound"),
    [(0.25, 2.0, 1.0), (0.25, 0.1, 0.25), (0.02, 2.0, 0.02), (0.35, 2.0, 0.35)],
    ids=["little", "hardly tried", "nothing", "enough"],
)
def test_plans_get_all_of_the_box_where_little_of_it_is_known_to_be_had(share, tried, bound):
    box = torch.tensor([[-1.0], [1.0]])
    found = extend(share * box, box, torch.tensor([tried]))
    torch.testing.assert_close(found, bound * box)


@pytest.fixture
def wishes(gains):
    generator = torch.Generator().manual_seed(0)
    planned = LOW + (HIGH - LOW) * torch.rand(500, 2, generator=generator)
    return planned, gains.sample((500,), generator), torch.zeros(500, 3)


def test_clipping_is_the_inverse(gains, wishes):
    planned, rows, state = wishes
    found = intend(gains, planned, rows, state, LOW, HIGH, "clip")
    assert torch.equal(found, gains.inverse(planned, rows, state, LOW, HIGH))


def test_the_direction_is_kept_at_the_largest_possible_scale(gains, wishes):
    planned, rows, state = wishes
    found = intend(gains, planned, rows, state, LOW, HIGH, "direction")
    assert (found >= LOW).all() and (found <= HIGH).all()
    effect = rows * found
    scale = (effect / planned).amax(-1, keepdim=True)
    aside = (effect - scale * planned).abs() / HIGH
    assert aside.max() < TOLERANCE + 1e-5
    largest = (rows.abs() * HIGH / planned.abs()).amin(-1, keepdim=True).clamp(max=1.0)
    assert (scale >= largest - 0.5**ROUNDS - 1e-5).all()


def test_an_action_that_can_be_had_is_had(gains, wishes):
    planned, rows, state = wishes
    found = intend(gains, planned, rows, state, LOW, HIGH, "direction")
    exact = planned / rows
    whole = (exact.abs() <= HIGH).all(-1)
    assert whole.sum() > 50
    torch.testing.assert_close(found[whole], exact[whole])


@pytest.mark.parametrize(("gain", "clipped"), [(0.18, True), (0.12, False), (-0.12, False)])
def test_the_third_way_depends_on_what_can_be_had(gains, gain, clipped):
    planned = torch.tensor([[1.0, 0.2], [-0.5, 0.2]])  # of the second enough can be had
    rows = torch.tensor([gain, 1.0]).expand(2, 2)
    clip, slow, mixed = (
        intend(gains, planned, rows, torch.zeros(2, 3), LOW, HIGH, mode)
        for mode in ("clip", "direction", "mixed")
    )
    assert not torch.allclose(clip[0], slow[0])
    torch.testing.assert_close(mixed[0], clip[0] if clipped else slow[0])
    torch.testing.assert_close(mixed[1], clip[1])


def test_the_third_way_is_the_same_for_samples_as_for_regimes(gains, wishes):
    planned, rows, state = wishes
    exact = planned / rows / HIGH
    # The scale is searched for, and small misses count for nothing.
    clear = (exact.abs().amax(-1) * 0.15 - 1).abs() > 0.3
    clear = clear & (rows.abs() > 0.1).all(-1) & (planned.abs() > 0.1).all(-1)
    assert clear.sum() > 100
    found = intend(gains, planned, rows, state, LOW, HIGH, "mixed") / HIGH
    torch.testing.assert_close(found[clear], saturate(exact, "mixed")[clear], rtol=0, atol=0.05)


@pytest.mark.parametrize("mode", MODES)
def test_where_no_scale_helps_the_nearest_effect_is_taken(gains, mode):
    planned, rows = torch.tensor([0.5, 1.0]), torch.tensor([0.0, 2.0])
    found = intend(gains, planned, rows, torch.zeros(3), LOW, HIGH, mode)
    assert found.isfinite().all() and (found.abs() <= HIGH).all()
