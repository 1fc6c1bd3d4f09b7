"""The model is asked about as little as possible when a flow is trained: it may be slow."""

import pytest
import torch

from afm_rl.dynamics import Dubins, Quadrotor
from afm_rl.flow import ContextFlow
from afm_rl.flow.counterfactuals import imagine, imagine_windows


class Counting(Dubins):
    def forecast(self, state, action):
        self.forecasts = state.shape[:-1].numel()
        return super().forecast(state, action)

    def jacobian(self, state, action):
        self.jacobians = state.shape[:-1].numel()
        return super().jacobian(state, action)


def test_rows_that_do_not_count_and_derivatives_in_the_box_are_left_out(box, states, gains):
    model, generator = Counting(), torch.Generator().manual_seed(0)
    flow = ContextFlow(*box, window=4, memory=9)
    seen, _ = imagine_windows(flow, model, gains, states, (200, 4), generator)
    assert model.forecasts == seen.valid.sum() < 800
    assert 0 < model.jacobians < 0.7 * model.forecasts
    moved = (seen.next_state != seen.state).any(-1)
    assert torch.equal(moved, seen.valid)


@pytest.mark.parametrize("kind", ["physics", "base class", "ensemble"])
def test_in_the_box_no_derivative_is_needed(kind, box, make_ensemble):
    model = {"physics": Dubins, "base class": Quadrotor, "ensemble": make_ensemble}[kind]()
    size, generator = model.action_size, torch.Generator().manual_seed(0)
    state, effect = model.manifold.project(torch.rand(5, model.state_size)), torch.zeros(5, size)
    low, high = -torch.ones(size), torch.ones(size)
    with torch.no_grad():
        expected, noise = model.forecast(state, effect)
        seen = imagine(model, state, effect, low, high, generator)
    error = model.manifold.difference(seen, expected)
    assert (error.abs() < 5 * noise).all()
