"""The midpoint rule."""

import math

import pytest
import torch

from afm_rl.correction.paper_flow import midpoint

ONE = torch.ones(1, dtype=torch.float64)


@pytest.mark.parametrize(
    ("velocity", "end"),
    [
        (lambda tau, x: x, math.e),
        (lambda tau, x: -2 * tau * x, math.exp(-1)),
        (lambda tau, x: -x * x, 0.5),
        (lambda tau, x: ONE * math.cos(5 * tau), 1 + math.sin(5) / 5),
    ],
    ids=["growth", "decay in time", "nonlinear", "forced"],
)
def test_half_the_step_is_a_quarter_of_the_error(velocity, end):
    errors = [abs(float(midpoint(velocity, ONE, steps)) - end) for steps in (20, 40, 80)]
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert coarse / fine == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_straight_and_parabolic_paths_are_exact(steps):
    start = torch.randn(5, 2, dtype=torch.float64)
    end = torch.randn(5, 2, dtype=torch.float64)
    torch.testing.assert_close(midpoint(lambda tau, x: end - start, start, steps), end)
    fallen = midpoint(lambda tau, x: torch.full_like(x, 2 * tau), start, steps)
    torch.testing.assert_close(fallen, start + 1)
