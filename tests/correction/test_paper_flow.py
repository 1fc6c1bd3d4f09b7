"""The published flow and its quirks."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import Context, PaperFlow, Window, midpoint, train_flow
from afm_rl.flow.cfm import held_out_error


@pytest.fixture
def make(box):
    def build(**settings):
        settings = {"gate": 0.05, "width": 16, **settings}
        return PaperFlow(*box, features=[2], state_size=3, **settings)

    return build


def last_of(flow, count, misaligned=False):
    features = torch.full((count, flow.feature_size), 7.0)
    none = torch.zeros(count, 1, 0), torch.zeros(count, 0)
    return Context(*none, features, torch.zeros(count), torch.full((count,), misaligned))


def window_of(state, planned, next_state, executed=None):
    valid = torch.ones(*state.shape[:-1], 1, dtype=torch.bool)
    executed = planned if executed is None else executed
    rows = (part.unsqueeze(-2) for part in (state, planned, executed, next_state))
    return Window(*rows, valid)


def test_the_gate_opens_at_its_threshold(make, transitions):
    flow, (state, action) = make(gate=0.05), transitions(3)
    reached = Dubins()(state, action)
    reached[:, 1] += torch.tensor([0.0, 0.049, 0.051])
    context = flow.context(window_of(state, action, reached), Dubins(), last_of(flow, 3))
    torch.testing.assert_close(context.surprise, torch.tensor([0, 0.049, 0.051]), rtol=0, atol=1e-5)
    assert context.misaligned.tolist() == [False, False, True]
    error = reached - Dubins()(state, action)
    expected = torch.cat([state[:, 2:], action, error], -1)
    torch.testing.assert_close(context.features, expected)


def test_before_the_first_transition_it_is_silent(make, transitions):
    flow, (state, action) = make(), transitions(2)
    window = window_of(state, action, state + 1.0)
    window.valid[:] = False
    context = flow.context(window, Dubins(), last_of(flow, 2))
    assert (context.surprise == 0).all() and not context.misaligned.any()


@pytest.mark.parametrize("wrap", [False, True])
def test_the_published_difference_jumps_at_the_seam(make, wrap):
    flow = make(wrap=wrap, gate=1.0)
    state, action = torch.tensor([[0.0, 0.0, 3.1]]), torch.tensor([[0.5, 1.0]])
    reached = Dubins()(state, action) + torch.tensor([0.0, 0.0, 2 * math.pi])  # the same heading
    context = flow.context(window_of(state, action, reached), Dubins(), last_of(flow, 1))
    assert bool(context.misaligned) is not wrap
    jump = 0.0 if wrap else 2 * math.pi
    assert float(context.surprise) == pytest.approx(jump, abs=1e-4)


@pytest.mark.parametrize("latch", [False, True])
def test_the_latch_keeps_what_opened_the_gate(make, transitions, latch):
    flow, (state, action) = make(latch=latch), transitions(3)
    reached = Dubins()(state, action)
    reached[:2, 0] += 1.0  # the third mission is aligned again
    window = window_of(state, action, reached)
    fresh = flow.context(window, Dubins(), last_of(flow, 3)).features
    held = flow.context(window, Dubins(), last_of(flow, 3, misaligned=True))
    old = last_of(flow, 3).features
    expected = torch.stack([old[0], old[1], fresh[2]]) if latch else fresh
    assert torch.equal(held.features, expected)
    assert held.misaligned.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("error_action", "corrected_well"), [("planned", False), ("executed", True)]
)
def test_the_error_is_taken_against_the_chosen_action(
    make, transitions, error_action, corrected_well
):
    flow, (state, planned) = make(error_action=error_action), transitions(5)
    planned[:, 0] = 0.9
    executed = planned * torch.tensor([-1.0, 1.0])
    reached = Dubins()(state, planned)  # a reversed motor, perfectly corrected
    window = window_of(state, planned, reached, executed)
    context = flow.context(window, Dubins(), last_of(flow, 5))
    assert context.misaligned.all() == corrected_well
    assert not context.misaligned.any() == (error_action == "planned")
    assert torch.equal(context.features[:, 1:3], planned)


def test_an_aligned_model_is_never_corrected(make, trained_ensemble, transitions):
    state, action = transitions(200)
    for model in (Dubins(), trained_ensemble):
        flow = make(wrap=True, gate=1e-3)
        window = window_of(state, action, model(state, action))
        assert not flow.context(window, model, last_of(flow, 200)).misaligned.any()


def test_examples_register_one_action_as_if_it_were_another(make, states, box):
    flow, generator = make(), torch.Generator().manual_seed(0)
    made = flow.examples(Dubins(), None, states, 100, generator)
    heading, planned, error = made.features.split([1, 2, 3], -1)
    assert torch.equal(planned, made.planned)
    state = torch.cat([torch.zeros(100, 2), heading], -1)
    seen, expected = Dubins()(state, made.intended), Dubins()(state, made.planned)
    torch.testing.assert_close(error, Dubins().manifold.difference(seen, expected))
    for part in (made.planned, made.intended):
        assert (part >= box[0]).all() and (part <= box[1]).all()
        assert float(part[:, 0].std()) == pytest.approx(2 / 12**0.5, rel=0.2)


def test_the_correction_integrates_from_the_planned_action(make, transitions):
    flow, (state, planned) = make(steps=4), transitions(6)
    context = last_of(flow, 6)._replace(features=torch.randn(6, flow.feature_size))
    corrected = flow.correct(context, state, planned)

    def velocity(tau, point):
        return flow(context.features, planned, torch.full((6, 1), tau), point)

    torch.testing.assert_close(corrected.action, midpoint(velocity, planned, 4))
    assert (corrected.spread == 0).all() and corrected.reach is None


def test_it_works_in_raw_units_from_the_planned_action(make):
    flow, action = make(), torch.tensor([0.3, -1.2])
    assert torch.equal(flow.normalise(action), action)
    assert torch.equal(flow.denormalise(action), action)
    assert torch.equal(flow.source(action, torch.randn(2)), action)
    assert (flow.window, flow.feature_size) == (1, 6)


def test_it_knows_one_direction_only(make):
    flow = make()
    assert not flow.has_effect and (flow.pair_size, flow.evidence_size) == (0, 0)
    with pytest.raises(NotImplementedError, match="PaperFlow knows one direction only"):
        flow.effect(torch.zeros(1, 6), torch.zeros(1, 2))


def test_it_learns_what_it_is_taught(make, states, gains):
    flow = make(width=32)
    made = flow.examples(Dubins(), gains, states, 1000, torch.Generator().manual_seed(5))
    before = held_out_error(flow, made)
    settings = {"iterations": 300, "batch_size": 128, "lr": 1e-2}
    assert train_flow(flow, Dubins(), gains, states, **settings) < 0.5 * before


@pytest.mark.parametrize(
    "settings",
    [
        {"state_size": 0},
        {"steps": 0},
        {"error_action": "wished"},
        {"gate": -1.0},
        {"features": [3]},
        {"features": [-1]},
        {"features": 2},
        {"seed": 1.5},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(box, settings):
    with pytest.raises(ConfigurationError, match=f"flow.{next(iter(settings))}"):
        PaperFlow(*box, **{"features": [2], "state_size": 3, **settings})
