"""The two formulas of MPPI against closed forms."""

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
