"""The two formulas of MPPI against closed forms."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.planning.mppi import path_weights, smooth

LOW, HIGH = torch.tensor([-1.0, -1.5]).double(), torch.tensor([1.0, 2.0]).double()


@pytest.mark.parametrize("within", [True, False])
@pytest.mark.parametrize("beta", [0.1, 0.6, 1.0])
def test_smoothing_equals_a_scalar_loop(beta, within):
    plan, past = 2 * torch.randn(3, 4, 6, 2).double(), torch.randn(3, 1, 2).double()
    smoothed = smooth(plan, past, beta, LOW, HIGH, within)
    assert smoothed.shape == plan.shape
    for i in range(3):
        for j in range(4):
            for k in range(2):
                now = float(past[i, 0, k])
                for h in range(6):
                    now = beta * float(plan[i, j, h, k]) + (1 - beta) * now
                    clamped = min(max(now, float(LOW[k])), float(HIGH[k]))
                    now = clamped if within else now
                    assert float(smoothed[i, j, h, k]) == pytest.approx(clamped)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(1e-3, 1e3))
def test_weights_are_a_softmax(returns, temperature):
    returns = torch.tensor(returns, dtype=torch.float64)
    weights = path_weights(returns, temperature)
    assert float(weights.sum()) == pytest.approx(1)
    torch.testing.assert_close(weights, (returns / temperature).softmax(-1))


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("shift", [0.0, 1e6, -1e6])
def test_any_scale_of_the_cost_gives_sound_weights(scale, shift):
    returns = -scale * torch.rand(7, 300, generator=torch.Generator().manual_seed(0))
    weights = path_weights(returns + shift, 0.01)
    assert weights.isfinite().all() and (weights >= 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(7))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_returns_that_are_not_finite_weigh_nothing(bad):
    returns = torch.tensor([0.0, bad, 1.0, bad], dtype=torch.float64)
    weights = path_weights(returns, 0.5)
    assert weights[[1, 3]].tolist() == [0.0, 0.0]
    torch.testing.assert_close(weights[[0, 2]], path_weights(returns[[0, 2]], 0.5))
    assert path_weights(torch.full((2, 3), bad), 0.5).abs().sum() == 0


def test_a_cold_temperature_takes_the_best_and_a_hot_one_the_mean():
    returns = torch.tensor([-2.0, -1.0, -3.0])
    assert path_weights(returns, 1e-9).tolist() == [0.0, 1.0, 0.0]
    torch.testing.assert_close(path_weights(returns, 1e9), torch.full((3,), 1 / 3))
