"""Actions that cannot be had in full."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.flow.saturation import ROUNDS, TOLERANCE, intend, saturate

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])


@given(st.lists(st.floats(-10, 10), min_size=2, max_size=2))
def test_both_modes_end_in_the_box_and_keep_what_fits(values):
    unit = torch.tensor(values, dtype=torch.float64)
    for mode in ("direction", "clip"):
        result = saturate(unit, mode)
        assert result.abs().max() <= 1 + 1e-12
        if unit.abs().max() <= 1:
            assert torch.equal(result, unit)


def test_one_mode_keeps_the_direction_the_other_the_components():
    unit = torch.tensor([[0.5, -2.0], [4.0, 2.0]])
    assert saturate(unit, "clip").tolist() == [[0.5, -1.0], [1.0, 1.0]]
    assert saturate(unit, "direction").tolist() == [[0.25, -1.0], [1.0, 0.5]]


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


def test_where_no_scale_helps_the_nearest_effect_is_taken(gains):
    planned, rows = torch.tensor([0.5, 1.0]), torch.tensor([0.0, 2.0])
    found = intend(gains, planned, rows, torch.zeros(3), LOW, HIGH, "direction")
    assert found.isfinite().all() and (found.abs() <= HIGH).all()
