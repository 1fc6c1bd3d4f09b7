"""Gains on the action axes."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain

STATE = torch.zeros(3)
SMALL = st.floats(-3, 3)


@given(SMALL, SMALL, SMALL, SMALL)
def test_the_inverse_undoes_the_gain_or_saturates(v, omega, first, second):
    gains = ActionGain(["v_gain", "omega_gain"])
    low, high = torch.tensor([-1.0, -1.5]).double(), torch.tensor([0.5, 1.5]).double()
    row = torch.tensor([first, second], dtype=torch.float64)
    wanted = torch.tensor([v, omega], dtype=torch.float64)
    found = gains.inverse(wanted, row, STATE, low, high)
    assert found.isfinite().all() and (found >= low).all() and (found <= high).all()
    for k in range(2):  # no other action of the box comes nearer
        rival = torch.linspace(float(low[k]), float(high[k]), 101, dtype=torch.float64)
        miss = abs(float(row[k] * found[k] - wanted[k]))
        assert miss <= float((row[k] * rival - wanted[k]).abs().min()) + 1e-9


def test_the_generic_search_agrees_with_the_closed_form(gains):
    low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    wanted = low + (high - low) * torch.rand(200, 2, generator=torch.Generator().manual_seed(0))
    rows = gains.sample((200,), torch.Generator().manual_seed(1))
    states = torch.zeros(200, 3)
    exact = gains.inverse(wanted, rows, states, low, high)
    before = torch.get_rng_state()
    found = gains.search(wanted, rows, states, low, high)
    assert torch.equal(torch.get_rng_state(), before)
    assert (found >= low).all() and (found <= high).all()
    torch.testing.assert_close(rows * found, rows * exact, rtol=0, atol=1e-2)


def test_the_prior_covers_what_it_says():
    family = ActionGain(["a", "b"], low=0.1, high=2.0, nominal=0.25)
    drawn = family.sample((4000, 5), torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, 5, 2)
    nominal = drawn == 1.0
    assert float(nominal.float().mean()) == pytest.approx(0.25, abs=0.01)
    changed = drawn[~nominal]
    assert changed.abs().min() >= 0.1 and changed.abs().max() <= 2.0 * (1 + 1e-6)
    assert float((changed < 0).float().mean()) == pytest.approx(0.5, abs=0.01)
    middle = math.sqrt(0.1 * 2.0)  # log-uniform: half of the gains are below
    assert float((changed.abs() < middle).float().mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("count", [1, 3])
def test_each_action_has_a_name(count):
    with pytest.raises(ConfigurationError, match="the robot has 2 actions; give one name for each"):
        names = [f"gain_{k}" for k in range(count)]
        ActionGain(names).apply(torch.ones(4, 2), torch.ones(4, count), torch.zeros(4, 3))
