"""A correction that begins with the first steps and lasts is said, once."""

import warnings

import pytest
import torch

from afm_rl.correction.first_steps import CORRECTED, HELD_BACK, STEPS, StepWarning


def said(steps, first=None):
    """Return what is said of steps (bool)."""
    first = first or StepWarning(CORRECTED)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for corrected in steps:
            first(torch.tensor([corrected]), lambda: "gain 0.5 on all")
    return [str(warning.message) for warning in found]


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ([True] * 300, 1),
        ([True, True, False] * 100, 1),  # episodes of three steps
        ([False] * 19 + [True] * 281, 1),
        ([False] * 20 + [True] * 280, 0),  # after calm steps, something changed
        ([True] * 40 + [False] * 260, 0),
        ([False] * 300, 0),
        ([True] * (STEPS - 1), 0),
    ],
)
def test_it_is_said_once_where_corrections_began_with_the_first_steps(steps, count):
    messages = said(steps)
    assert len(messages) == count
    for text in messages:
        assert "first 60 steps were corrected (gain 0.5 on all)" in text
        assert "Either the robot changed before the start, or the model is wrong" in text


def test_a_false_alarm_of_few_missions_leaves_the_first_steps_calm():
    first = StepWarning(CORRECTED)
    alarms = torch.zeros(300, 10, dtype=torch.bool)
    alarms[:, 0] = True  # one mission of ten is corrected from the start
    alarms[25:] = True  # a fault in all
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for corrected in alarms:
            first(corrected, str)


@pytest.mark.parametrize(
    ("held", "count"),
    [
        ([True] * 300, 1),
        ([True, True, False] * 100, 1),
        ([False] * 200 + [True] * 120, 1),
        ([True, False] * 200, 0),
    ],
)
def test_that_limits_hold_back_is_said_once_whenever_it_begins(held, count):
    messages = said(held, StepWarning(HELD_BACK, again=True))
    assert len(messages) == count
    assert all("of 60 steps were held back by the limits" in text for text in messages)


def test_numbers_are_not_looked_at_on_the_way_nor_in_a_compiled_tick():
    first = StepWarning(CORRECTED)
    for _ in range(STEPS - 1):
        first(torch.ones(2, dtype=torch.bool, device="meta"), str)
    assert len(first.happened) == STEPS - 1
    first = StepWarning(CORRECTED)

    @torch.compile(backend="eager", fullgraph=True)
    def tick(values):
        first(values > 0, str)
        return values + 1

    assert tick(torch.ones(2)).tolist() == [2, 2] and not first.happened
