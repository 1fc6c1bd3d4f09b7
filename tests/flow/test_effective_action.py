"""What an executed action turned out to be worth."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins, Oracle
from afm_rl.flow import effective_action

HALF = torch.tensor([1.0, 1.5])


def seen(model, state, action, next_state):
    half = HALF.to(state.dtype)
    return effective_action(model, state, action, next_state, half)


@pytest.mark.parametrize("batch", [(), (200,), (4, 6)])
def test_gains_are_recovered_exactly_from_the_nominal_robot(gains, transitions, batch):
    state, action = transitions(*batch, dtype=torch.float64)
    rows = gains.sample(batch, torch.Generator().manual_seed(0)).double()
    found = seen(Dubins(), state, action, Dubins()(state, rows * action))
    torch.testing.assert_close(found.effective, rows * action, rtol=1e-4, atol=1e-4)


def test_a_model_that_is_right_finds_what_was_executed(trained_ensemble, transitions):
    for model in (Dubins(), trained_ensemble):
        state, action = transitions(50)
        found = seen(model, state, action, model(state, action))
        torch.testing.assert_close(found.effective, action, rtol=0, atol=1e-3)
        assert float(found.surprise.max()) < 0.01


def test_gains_are_recovered_about_from_an_ensemble(trained_ensemble, gains, transitions):
    state, action = transitions(300)
    rows = torch.tensor([-0.8, 1.2])
    found = seen(trained_ensemble, state, action, Dubins()(state, rows * action))
    miss, nothing = ((part - rows * action) / HALF for part in (found.effective, action))
    assert miss.abs().median() < 0.17 * nothing.abs().median()
    # The mean square is that of few where a network's slope misleads: it differs with rounding.
    assert miss.square().mean() < 0.5**2 * nothing.square().mean()


def test_the_told_oracle_sees_nothing_amiss(gains, transitions):
    oracle = Oracle(Dubins(), gains)
    oracle.tell(gains.encode({"v_gain": -1.5}))
    state, action = transitions(20)
    reached = oracle(state, action)
    assert float(seen(oracle, state, action, reached).surprise.max()) < 1e-2
    assert float(seen(Dubins(), state, action, reached).surprise.max()) > 5


def test_the_surprise_is_the_largest_error_in_standard_deviations():
    model = Dubins(noise_std=0.01)
    state, action = torch.zeros(3), torch.tensor([0.5, 0.5])
    reached = model(state, action) + torch.tensor([0.03, -0.07, 0.02])
    assert float(seen(model, state, action, reached).surprise) == pytest.approx(7, rel=1e-4)


def test_crossing_the_seam_is_no_surprise():
    model = Dubins()
    state = torch.stack([torch.zeros(100), torch.zeros(100), torch.linspace(2.9, 3.14, 100)], -1)
    action = torch.tensor([0.5, 1.5]).expand(100, 2)
    reached = model(state, action)
    assert (reached[:, 2] < 0).sum() > 50
    found = seen(model, state, action, reached)
    assert float(found.surprise.max()) < 0.01
    torch.testing.assert_close(found.effective, action, rtol=0, atol=1e-4)


def test_an_axis_without_influence_stays_where_it_is(transitions):
    class Rail(Dubins):
        """Cannot turn, whatever omega."""

        def forward(self, state, action):
            return super().forward(state, action * torch.tensor([1.0, 0.0]).to(action))

        def jacobian(self, state, action):
            return super().jacobian(state, action) * torch.tensor([1.0, 0.0]).to(action)

    state, action = transitions(30, dtype=torch.float64)
    reached = Dubins()(state, action * torch.tensor([-1.0, 3.0]).double())
    found = seen(Rail(), state, action, reached)
    torch.testing.assert_close(found.effective[:, 1], action[:, 1])
    torch.testing.assert_close(found.effective[:, 0], -action[:, 0], rtol=1e-4, atol=1e-4)


def test_the_unit_of_the_action_does_not_matter(gains, transitions):
    class Percent(Dubins):
        """Takes v in percent."""

        def forward(self, state, action):
            return super().forward(state, action / torch.tensor([100.0, 1.0]).to(action))

        def jacobian(self, state, action):
            return super().jacobian(state, action) / torch.tensor([100.0, 1.0]).to(action)

    state, action = transitions(30, dtype=torch.float64)
    unit = torch.tensor([100.0, 1.0]).double()
    reached = Dubins()(state, -0.5 * action) + 0.01
    usual = seen(Dubins(), state, action, reached)
    percent = effective_action(Percent(), state, action * unit, reached, HALF.double() * unit)
    torch.testing.assert_close(percent.effective / unit, usual.effective)
    torch.testing.assert_close(percent.surprise, usual.surprise)


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("where", [0, 1, 2])
def test_a_faulty_row_does_not_disturb_the_others(trained_ensemble, transitions, fault, where):
    for model in (Dubins(), trained_ensemble):
        state, action = transitions(4)
        reached = Dubins()(state, -action)
        expected = seen(model, state, action, reached)
        parts = [state.clone(), action.clone(), reached.clone()]
        parts[where][2] = fault
        found = seen(model, *parts)
        rows = torch.tensor([0, 1, 3])
        torch.testing.assert_close(found.effective[rows], expected.effective[rows])
        torch.testing.assert_close(found.surprise[rows], expected.surprise[rows])
