"""When regimes change."""

import math

import pytest
import torch
from harness import refused

from afm_rl.regimes import Schedule, blend_phases, phase_parameters


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("at", [0.15, 0.3, 0.5, 0.7, 0.8])
def test_a_phase_begins_beyond_its_breakpoint(at, dtype):
    exact = torch.tensor(at, dtype=dtype)
    progress = torch.stack([exact - 1e-6, exact, exact + 1e-6])
    assert Schedule([at]).phase(progress, torch.zeros(3)).tolist() == [0, 0, 1]


def test_a_schedule_by_steps_ignores_progress():
    schedule = Schedule([2, 5], by="step")
    steps = torch.arange(8)
    assert schedule.phase(torch.rand(8), steps).tolist() == [0, 0, 0, 1, 1, 1, 2, 2]


def test_missions_may_have_breakpoints_of_their_own():
    at = torch.tensor([[0.1, 0.2], [0.5, math.inf]])
    progress = torch.tensor([0.4, 0.9])
    assert Schedule().phase(progress, torch.zeros(2), at).tolist() == [2, 1]


def test_a_padded_schedule_has_phases_that_never_begin():
    schedule = Schedule([2], by="step")
    roomy = schedule.padded(4)
    assert (roomy.phases, roomy.by, schedule.phases) == (4, "step", 2)
    assert roomy.phase(torch.rand(2), torch.tensor([2, 10**9])).tolist() == [0, 1]
    assert roomy.padded(2).at == roomy.at  # room enough


def test_without_a_ramp_a_change_is_sudden_to_the_bit():
    rows = torch.randn(50, 3, 2, generator=torch.Generator().manual_seed(0))
    phase, none = torch.arange(50) % 3, torch.zeros(50, dtype=torch.int64)
    assert torch.equal(blend_phases(rows, phase, none, none), phase_parameters(rows, phase))


@refused(
    ({"at": [0.8, 0.15]}, "expected increasing breakpoints"),
    ({"at": [1.5]}, r"at=1.5: .* in \[0, 1\]"),
    ({"at": [math.inf], "by": "step"}, "at=inf: expected a finite number"),
)
def test_impossible_schedules_are_refused(settings):
    Schedule(**settings)
