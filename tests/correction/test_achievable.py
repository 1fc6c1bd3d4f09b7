"""Actions that cannot be had in full."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.correction.achievable import MODES, attainable, extend, saturate


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
