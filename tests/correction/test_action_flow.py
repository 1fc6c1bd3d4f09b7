"""The action flow as a corrector: pairs, memory, batches, bounds; its core has tests of its own."""

import math
import os

import pytest
import torch
from effects import flow_of, half_reversed

from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.correction.belief import remember


def upset(sent):
    """Half of the axes are reversed, all are biased."""
    return half_reversed(sent) + 0.1


@pytest.mark.parametrize(
    ("reached", "corrected", "pair"),
    [
        (0.3005, 0.0, (0.3, 0.3, 1.0)),  # half a standard deviation needs no explanation
        (0.3005, 1.0, (0.3, 0.3005, 1.0)),  # but all is explained where actions are corrected
        (50.0, 0.0, (0.3, 4.0, 1.0)),  # larger effects are not informative
        (math.nan, 0.0, (0.3, 0.0, 0.0)),  # the command is known, its effect is not
    ],
)
def test_a_transition_becomes_a_pair(line, reached, corrected, pair):
    flow, model, sent = flow_of(1), line(1, noise_std=1e-3), torch.tensor([[0.3]])
    memory = flow.executing(flow.begin(torch.zeros(1, 1)), sent, sent)
    memory = flow.observe(memory, torch.tensor([[reached]]))
    fields = memory | {"corrected": torch.tensor([[corrected]])}
    memory = remember(flow.core_of(fields), flow.measure(fields, model)[0])
    newest = torch.stack([memory.commands[0, 0, -1], memory.effects[0, 0, -1]])
    torch.testing.assert_close(newest[0], torch.tensor(pair[0]))
    assert memory.validity[0, -1] == pair[2]
    if pair[2]:
        torch.testing.assert_close(newest[1], torch.tensor(pair[1]), rtol=0, atol=1e-5)


def test_an_action_that_actuators_report_is_predicted_when_it_acts():
    low, high = torch.tensor([-2.0, -1.0]), torch.tensor([2.0, 4.0])
    flow = ActionFlow(low, high, delay=2)
    memory, sent = flow.begin(torch.zeros(3)), torch.tensor([1.0, 2.0])
    for _ in range(3):
        memory = flow.observe(flow.executing(memory, sent, sent), torch.randn(3))
    memory = flow.executing(memory, sent, sent)
    reported = flow.reported(memory, torch.tensor([0.5, 4.0]))
    moved = reported["forecasts"] - memory["forecasts"]
    expected = torch.tensor([-0.25, 0.5]).unsqueeze(-1).expand_as(moved)
    torch.testing.assert_close(moved, expected)


def test_an_effect_is_as_uncertain_as_hypotheses_differ_and_as_nothing_explains(line):
    flow, command = flow_of(1), torch.tensor([0.4])
    memory = flow.begin(torch.zeros(1))
    differ, noise = (flow.predict(memory, x * command, line(1))[1] for x in (1, 0))
    torch.testing.assert_close(noise, flow.noise_in(memory), rtol=0.01, atol=0)  # at rest all agree
    followed = flow.follow(memory, command, line(1))
    effects = followed["forecasts"]
    weights = flow.weights_in(followed).mT
    variance = (weights * effects.square()).sum(-1) - (weights * effects).sum(-1).square()
    torch.testing.assert_close(differ, (variance + noise.square()).sqrt())


def filled(correction):
    return [field for field in correction if field is not None]


@pytest.mark.parametrize("kind", [ActionFlow, LeastSquares])
def test_pairs_from_before_a_change_stay_old_when_a_learning_model_measures_again(line, kind):
    box = torch.tensor([[-1.0], [1.0]])
    corrector, model = kind(*box), line(1)
    model.taught_in = os.getpid()
    memory, state = corrector.begin(torch.zeros(1)), torch.zeros(1)
    for step in range(10):
        memory, found = corrector.correct(memory, torch.full((1,), 0.5), model, box)
        state = model(state, found.executed_action if step < 6 else -found.executed_action)
        memory = corrector.observe(memory, state)
    memory, _ = corrector.correct(memory, torch.full((1,), 0.5), model, box)
    validity = memory["validity"] if kind is ActionFlow else memory["pairs"][..., 3]
    assert validity[-10:].tolist() == 6 * [0.5] + 4 * [1.0]


@pytest.mark.parametrize("corrector", [ActionFlow, LeastSquares])
def test_bounds_in_double_precision_are_answered_in_it(line, drive, plans, corrector):
    ends = torch.ones(2, dtype=torch.float64)
    found, _ = drive(corrector(-ends, ends), line(2), upset, plans(8, 2, size=1.0).double())
    assert found.corrected[-1].all() and found.executed_action.dtype == torch.float64


def test_answers_do_not_depend_on_the_precision_of_a_mission_before(line, drive, plans):
    planned, flow = plans(8, 2, 2), flow_of(2)
    for precision in (torch.float64, torch.float32, torch.float64):
        found, _ = drive(flow, line(2), upset, planned.to(precision))
        fresh, _ = drive(flow_of(2), line(2), upset, planned.to(precision))
        assert found.executed_action.dtype is precision
        assert torch.equal(found.executed_action, fresh.executed_action)


@pytest.mark.parametrize("size", [1, 2, 6])
@pytest.mark.parametrize("coordinates", [[], [0]], ids=["", "by context"])
def test_a_batch_equals_single_missions(line, drive, plans, size, coordinates):
    flow = flow_of(size, context_coordinates=coordinates)
    planned = plans(6, 4, size)
    factor = torch.tensor([1.0, -1.0, 0.5, 0.0]).view(4, 1)  # one is healthy, one is dead
    together, _ = drive(flow, line(size), lambda sent: factor * sent[-1], planned)
    assert not together.corrected[:, 0].any() and together.corrected[4:, 1].all()
    for k in range(4):
        alone, _ = drive(flow, line(size), lambda s, k=k: factor[k] * s[-1], planned[:, k])
        for one, many in zip(filled(alone), filled(together), strict=True):
            torch.testing.assert_close(one, many[:, k], rtol=1e-3, atol=1e-3)


def test_a_belief_is_a_distribution_over_causes(line, drive, plans):
    flow = flow_of(2)
    drive(flow, line(2), lambda sent: -sent[-1], plans(12, 2))
    belief = flow.belief_in(drive.memory)
    torch.testing.assert_close(belief.sum(-2), torch.ones(2))
    assert belief.shape == (len(flow.causes), 2) and (belief[0] < 0.1).all()
    assert flow.cause_in(drive.memory) == "gain -1 on all: a sign of the model?"


def test_nothing_is_stored():
    """There are no weights: constants are made with the corrector."""
    assert not flow_of(2).state_dict()
