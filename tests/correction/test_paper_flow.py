"""The published flow and its quirks."""

import copy
import math

import pytest
import torch
from harness import same_weights

from afm_rl.correction import PaperFlow
from afm_rl.correction.paper_flow import midpoint
from afm_rl.correction.training import train_flow
from afm_rl.dynamics import Dubins, Quadrotor


@pytest.fixture
def make(box):
    def build(**settings):
        settings = {"gate": 0.05, "width": 16, **settings}
        return PaperFlow(*box, features=[2], state_size=3, **settings)

    return build


def after(flow, state, planned, reached, executed=None, begun=None, model=None):
    """Return the parts of the memory, and the correction, after one transition."""
    memory = flow.begin(state) if begun is None else begun
    memory = flow.executing(memory, planned, planned if executed is None else executed)
    memory = flow.observe(memory, reached)
    box = torch.stack([flow.denormalise(end) for end in (flow.lowest, flow.highest)])
    box = box.expand(*state.shape[:-1], 2, 2)
    memory, found = flow.correct(memory, planned, model or Dubins(), box)
    return memory, found


def test_the_gate_opens_at_its_threshold(make, transitions):
    flow, (state, action) = make(gate=0.05), transitions(3)
    reached = Dubins()(state, action)
    reached[:, 1] += torch.tensor([0.0, 0.049, 0.051])
    parts, found = after(flow, state, action, reached)
    size = torch.tensor([0, 0.049, 0.051])
    torch.testing.assert_close(found.innovation, size, rtol=0, atol=1e-5)
    assert found.corrected.tolist() == [False, False, True]
    assert torch.equal(found.executed_action[:2], action[:2])
    error = reached - Dubins()(state, action)
    expected = torch.cat([state[:, 2:], action, error], -1)
    torch.testing.assert_close(parts["features"], expected)


def test_before_the_first_transition_nothing_is_corrected(make, transitions):
    flow, (state, action) = make(gate=1e-6), transitions(2)
    box = torch.stack([action, action + 1], -2)
    _, found = flow.correct(flow.begin(state), action, Dubins(), box)
    assert not found.innovation.any() and torch.equal(found.executed_action, action)


@pytest.mark.parametrize("wrap", [False, True])
def test_the_published_difference_jumps_at_the_seam(make, wrap):
    flow = make(wrap=wrap, gate=1.0)
    state, action = torch.tensor([[0.0, 0.0, 3.1]]), torch.tensor([[0.5, 1.0]])
    reached = Dubins()(state, action) + torch.tensor([0.0, 0.0, 2 * math.pi])  # the same heading
    _, found = after(flow, state, action, reached)
    assert bool(found.corrected) is not wrap
    assert float(found.innovation) == pytest.approx(0.0 if wrap else 2 * math.pi, abs=1e-4)


@pytest.mark.parametrize("latch", [False, True])
def test_the_latch_keeps_what_opened_the_gate(make, transitions, latch):
    flow, (state, action) = make(latch=latch), transitions(3)
    reached = Dubins()(state, action)
    reached[:2, 0] += 1.0  # the third mission is align again
    fresh = after(flow, state, action, reached)[0]["features"]
    old = torch.full((3, flow.feature_size), 7.0)
    begun = flow.begin(state) | {"features": old, "corrected": torch.ones(3, 1)}
    parts, found = after(flow, state, action, reached, begun=begun)
    expected = torch.stack([old[0], old[1], fresh[2]]) if latch else fresh
    assert torch.equal(parts["features"], expected)
    assert found.corrected.tolist() == [True, True, False]


@pytest.mark.parametrize("error_action", ["planned", "executed"])
def test_the_error_is_taken_against_the_chosen_action(make, transitions, error_action):
    flow, (state, planned) = make(error_action=error_action), transitions(5)
    planned[:, 0] = 0.9
    executed = planned * torch.tensor([-1.0, 1.0])
    reached = Dubins()(state, planned)  # a reversed motor, perfectly corrected
    parts, found = after(flow, state, planned, reached, executed)
    assert found.corrected.tolist() == [error_action == "executed"] * 5
    assert torch.equal(parts["features"][:, 1:3], planned)


def test_the_rule_as_the_authors_coded_it(make):
    """Plan and execute it; a surprise lets the next step describe the regime, untransformed."""
    flow, model = make(rule="code", gate=0.5), Dubins()
    state, last = torch.tensor([[0.0, 0.0, 0.3]]), None
    box = torch.tensor([[[-1.0, -1.6], [1.0, 1.6]]])
    memory, transformed, registered = flow.begin(state), [], []
    surprises = [0.0, 0.0, 0.7, 0.6, 0.0, 0.2, 0.0]  # error of the step that was planned last
    for step, surprise in enumerate(surprises):
        planned = torch.tensor([[0.1 * (step + 1), -0.2]])
        if step:
            state = model(state, last) + torch.tensor([surprise, 0.0, 0.0])
            memory = flow.observe(memory, state)
        memory, found = flow.correct(memory, planned, model, box)
        assert bool(found.corrected) or torch.equal(found.executed_action, planned)
        assert float(found.innovation) == pytest.approx(surprise if step else 0.0, abs=1e-5)
        transformed.append(bool(found.corrected))
        registered.append(memory["features"][0].tolist())
        last = planned
    # The first step raises an alarm, so the second describes the regime; the surprise of step 2
    # raises the next one, so step 3 does: with the surprise that it has itself.
    assert transformed == [False, False, True, False, True, True, True]
    assert not any(registered[0])
    for steps, (plan, error) in {(1, 2): (0.1, 0.0), (3, 4, 5, 6): (0.3, 0.6)}.items():
        for step in steps:
            assert registered[step][1] == pytest.approx(plan)
            assert registered[step][3:] == pytest.approx([error, 0.0, 0.0], abs=1e-5)


def test_the_rule_as_coded_predicts_before_the_model_learns(make, transitions):
    flow, (state, action) = make(rule="code", gate=0.5), transitions(2)
    box = torch.stack([action - 1, action + 1], -2)
    memory, _ = flow.correct(flow.begin(state), action, Dubins(), box)
    memory = flow.observe(memory, Dubins()(state, action))
    other = Dubins(dt=1.0)  # what the model has become since
    _, found = flow.correct(memory, action, other, box)
    assert float(found.innovation.max()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("wrap", [False, True])
def test_examples_register_one_action_as_if_it_were_another(make, states, box, wrap):
    flow, generator = make(wrap=wrap), torch.Generator().manual_seed(0)
    features, planned, other = flow._examples(Dubins(), states, 100, generator)
    heading, registered, error = features.split([1, 2, 3], -1)
    assert torch.equal(registered, planned)
    state = torch.cat([torch.zeros(100, 2), heading], -1)
    seen, expected = Dubins()(state, other), Dubins()(state, planned)
    wrapped = Dubins().manifold.difference(seen, expected)
    torch.testing.assert_close(error, wrapped if wrap else seen - expected)
    assert bool((error[:, 2].abs() > math.pi).any()) is not wrap
    for part in (planned, other):
        assert (part >= box[0]).all() and (part <= box[1]).all()
        assert float(part[:, 0].std()) == pytest.approx(2 / 12**0.5, rel=0.2)


def test_training_changes_neither_the_model_nor_its_noise_and_gradients_may_be_off(
    make, states, make_ensemble
):
    model, flows = make_ensemble(propagation="sample"), [make(), make()]
    before, noise = copy.deepcopy(model), model.streams.generator().get_state()
    with torch.no_grad():
        errors = {train_flow(flow, model, states, iterations=2, batch_size=8) for flow in flows}
    assert len(errors) == 1 and torch.equal(model.streams.generator().get_state(), noise)
    assert same_weights(model, before) and not same_weights(flows[0], make())


def test_the_correction_integrates_from_the_planned_action_in_raw_units(make, transitions):
    flow, (state, planned) = make(steps=4), transitions(6)
    parts, found = after(flow, state, planned, Dubins()(state, -planned))
    assert found.corrected.all()

    def velocity(tau, point):
        return flow(parts["features"], torch.full((6, 1), tau), point)

    expected = midpoint(velocity, planned, 4).clamp(
        flow.denormalise(flow.lowest), flow.denormalise(flow.highest)
    )
    torch.testing.assert_close(found.executed_action, expected)
    assert torch.equal(found.predicted_effect, planned)


@pytest.mark.check
def test_it_learns_what_it_is_taught(make, states):
    flow = make(width=32, wrap=True)
    fresh = torch.Generator().manual_seed(5)
    before = flow.held_out_error(Dubins(), states, 1000, fresh)
    settings = {"iterations": 500, "batch_size": 128, "lr": 1e-2}
    assert train_flow(flow, Dubins(), states, **settings) < 0.5 * before


def test_the_weights_that_did_best_on_held_out_examples_are_kept(make, states, monkeypatch):
    monkeypatch.setattr("afm_rl.correction.training.paper.APART", 1)
    flow, looks, errors = make(), [], iter([0.5, 0.2, 0.9, 0.3])  # the last: of new examples

    def look(*arguments):
        looks.append({name: value.clone() for name, value in flow.state_dict().items()})
        return next(errors)

    flow.held_out_error = look
    assert train_flow(flow, Dubins(), states, iterations=3, batch_size=8) == 0.3
    for name, value in flow.state_dict().items():
        assert torch.equal(value, looks[1][name]) and torch.equal(value, looks[3][name])
    assert any(not torch.equal(value, looks[2][name]) for name, value in looks[1].items())


def test_progress_can_be_shown_on_a_terminal(make, states, monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    for progress in (False, True):
        train_flow(make(), Dubins(), states, iterations=4, batch_size=8, progress=progress)
        assert ("training the flow" in capsys.readouterr().err) == progress


def test_training_states_lie_on_the_manifold(monkeypatch):
    seen = []
    monkeypatch.setattr(
        Quadrotor, "forward", lambda model, state, action: seen.append(state) or state
    )
    monkeypatch.setattr("afm_rl.spaces.manifold.Manifold.difference", lambda m, a, b: a - b)
    states, generator = (torch.zeros(13), torch.ones(13)), torch.Generator().manual_seed(0)
    flow = PaperFlow(torch.tensor([0.0, -1.0, -1.0, -1.0]), torch.ones(4), [3, 4], 13)
    flow._examples(Quadrotor(), states, 8, generator)
    torch.testing.assert_close(seen[-1][..., 6:10].norm(dim=-1), torch.ones(8))


ONE = torch.ones(1, dtype=torch.float64)


@pytest.mark.parametrize(
    ("velocity", "end"),
    [
        (lambda tau, x: -2 * tau * x, math.exp(-1)),
        (lambda tau, x: -x * x, 0.5),
    ],
    ids=["decay in time", "nonlinear"],
)
def test_half_the_step_is_a_quarter_of_the_error(velocity, end):
    errors = [abs(float(midpoint(velocity, ONE, steps)) - end) for steps in (20, 40, 80)]
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert coarse / fine == pytest.approx(4, rel=0.1)
