"""The contract of correctors: one memory, three pure functions."""

import copy
import math

import pytest
import torch

from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares, PaperFlow
from afm_rl.correction.base import TRANSITION, Corrector
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.faults import PATIENCE
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms.delay_compensation import state_at_arrival

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])


class Watching(Corrector):
    """Keeps three transitions, and corrects nothing."""

    def __init__(self, low=LOW, high=HIGH, delay=0):
        super().__init__(low, high, recent=3, delay=delay)

    def answer(self, memory, planned, model, bounds, limits):
        return {}, self.unchanged(planned, planned[..., 0], bounds)


def random_memory(corrector, count):
    """Return a memory with random numbers."""
    memory = corrector.begin(torch.zeros(count, 3))
    return {name: torch.rand(field.shape) for name, field in memory.items()}


def correctors():
    """One of each kind."""
    return {
        "flow": ActionFlow(LOW, HIGH),
        "flow by context": ActionFlow(LOW, HIGH, context_coordinates=[0, 1]),
        "gain": LeastSquares(LOW, HIGH),
        "gain and offset": LeastSquares(LOW, HIGH, form="gain_offset"),
        "affine": LeastSquares(LOW, HIGH, form="affine"),
        "l1": L1Augmentation(LOW, HIGH, dt=0.2),
        "paper": PaperFlow(LOW, HIGH, [2], 3, width=8, gate=0.05),
    }


@pytest.fixture(params=correctors())
def corrector(request):
    return correctors()[request.param]


def test_actions_are_handled_as_shares_of_the_largest():
    corrector = Watching(torch.tensor([0.0, -1.0]), torch.tensor([4.0, 2.0]))
    corners = torch.tensor([[0.0, -1.0], [2.0, 1.0], [4.0, 2.0]])
    unit = corrector.normalise(corners)
    assert unit.tolist() == [[0.0, -0.5], [0.5, 0.5], [1.0, 1.0]]
    assert torch.equal(corrector.denormalise(unit), corners)
    assert corrector.action_size == 2


def test_a_mission_begins_with_its_state_and_nothing_else(corrector):
    state = torch.rand(2, 3)
    memory = corrector.begin(state)
    assert torch.equal(memory.pop("state"), state)
    noise = memory.pop("noise", None)
    assert noise is None or (noise == 0.05).all()
    assert memory.pop("trusted").all()
    assert not any(field.any() for field in memory.values())


def test_who_begins_again_keeps_what_was_learnt(corrector):
    before, state = random_memory(corrector, 4), torch.rand(4, 3)
    again, begun = corrector.resume(before, state), corrector.begin(state)
    again.pop("carryover")
    for name in TRANSITION:  # others may have moved the robot
        before[name][..., -1, :] = begun[name][..., -1, :]
    for name in ("commands", "effects", "stds", "validity"):  # of the last mission none acts now
        if name in before:
            old = before[name].unbind(-1)[corrector.core.newest :]
            before[name] = torch.stack([*old, *begun[name].unbind(-1)[len(old) :]], -1)
    if "contexts" in before:  # where there is no reading yet, the place stays the last one
        places = before["contexts"].unbind(-1)
        kept = places[corrector.core.newest :]
        before["contexts"] = torch.stack([*kept, *places[-1:] * corrector.core.newest], -1)
    assert set(corrector.episodic) - {"derivative"} <= set(again)
    for name, part in again.items():
        assert torch.equal(part, (begun if name in corrector.episodic else before)[name])


def test_transitions_count_when_commands_from_before_a_reset_act_no_more():
    corrector = Watching(delay=2)
    memory = corrector.resume(corrector.begin(torch.zeros(3)), torch.ones(3))
    for _ in range(4):
        memory = corrector.observe(memory, torch.rand(3))
    assert memory["valid"][:, 0].tolist() == [0.0, 1.0, 1.0]  # the last three of four


def test_before_the_first_action_the_one_nearest_to_zero_was_sent():
    low, high = torch.tensor([0.5, -3.0, -1.0, 0.0]), torch.tensor([2.0, -1.5, 1.0, 4.0])
    corrector = Watching(low, high, delay=2)
    queue = corrector.begin(torch.zeros(3, 1))["queue"]
    assert torch.equal(queue, torch.tensor([0.5, -1.5, 0.0, 0.0]).expand(3, 2, 4))


def test_arrival_is_the_state_after_the_commands_under_way_or_the_present_one():
    model = KnownDynamics(lambda state, action: state + 1 / action, Manifold(1), 1)
    corrector = Watching(-torch.ones(1), torch.ones(1), delay=2)
    memory = corrector.begin(torch.tensor([[5.0], [6.0]]))
    sent = torch.tensor([[[0.5], [0.25]], [[1.0], [0.0]]])  # the second leads to no number
    memory = memory | {"queue": sent}
    state, steps = state_at_arrival(corrector, memory, model, corrector.delay_in(memory))
    assert state.tolist() == [[11.0], [6.0]] and steps.tolist() == [2, 0]


def test_transitions_are_kept_oldest_first():
    corrector, states = Watching(), torch.rand(6, 4, 3)
    actions = torch.rand(5, 4, 2)
    memory = corrector.begin(states[0])
    for k in range(5):
        memory = corrector.executing(memory, actions[k], -actions[k])
        memory = corrector.observe(memory, states[k + 1])
    names = ("states", "planned_actions", "actions", "next_states", "valid")
    state, planned, executed, reached, valid = (memory[name] for name in names)
    for k in range(3):
        assert torch.equal(state[:, k], states[2 + k])
        assert torch.equal(reached[:, k], states[3 + k])
        assert torch.equal(planned[:, k], actions[2 + k])
        assert torch.equal(executed[:, k], -actions[2 + k])
    assert (valid == 1.0).all() and torch.equal(memory["state"], states[5])


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf, 1e30])
def test_a_faulty_reading_spoils_two_transitions(fault):
    corrector, states = Watching(), torch.rand(5, 2, 3)
    states[2, 0, 1] = fault
    memory, valid = corrector.begin(states[0]), []
    for state in states[1:]:
        memory = corrector.observe(memory, state)
        valid.append(memory["valid"][:, -1, 0])
    assert torch.stack(valid, 1).tolist() == [[1, 0, 0, 1], [1, 1, 1, 1]]


def test_a_stale_reading_does_not_count_until_it_is_believed():
    corrector, memory = Watching(), Watching().begin(torch.zeros(3))
    valid = []
    for _ in range(PATIENCE + 3):
        memory = corrector.observe(memory, torch.zeros(3))
        valid.append(bool(memory["valid"][-1]))
    assert valid == [False] * (PATIENCE + 1) + [True] * 2


def test_corrections_are_pure_functions_and_have_the_shapes_that_are_promised(corrector):
    model, box = Dubins(), torch.stack([LOW, HIGH]).expand(2, 2, 2)
    memory, plan = corrector.begin(torch.zeros(2, 3)), torch.tensor([[0.5, 0.2], [0.3, -0.4]])
    for _ in range(5):
        given = copy.deepcopy((memory, plan, box))
        after, found = corrector.correct(memory, plan, model, box)
        again = corrector.correct(memory, plan, model, box)
        torch.testing.assert_close(again, (after, found), rtol=0, atol=0)
        torch.testing.assert_close((memory, plan, box), given, rtol=0, atol=0)
        shapes = [part.shape for part in found if part is not None]
        assert shapes == [(2, *shape) for shape in ((2,), (2,), (2,), (2, 2), (), (), (2,))]
        memory = corrector.observe(after, model(after["state"], -found.executed_action))
    assert found.corrected.all()


def test_no_reading_makes_an_action_that_is_not_finite(corrector):
    """Many missions at once, each with faults of its own."""
    faults = torch.tensor([0.3, -2.0, math.nan, math.inf, -math.inf, 1e30])
    generator = torch.Generator().manual_seed(0)
    drawn = faults[torch.randint(6, (4, 64, 3), generator=generator)]
    sound = torch.rand(4, 64, 3, generator=generator)
    faulty = torch.where(torch.rand(4, 64, 1, generator=generator) < 0.5, drawn, sound)
    model, box = Dubins(), torch.stack([LOW, HIGH]).expand(64, 2, 2)
    memory, plan = corrector.begin(faulty[0]), torch.tensor([0.5, 0.2]).expand(64, 2)
    for state in (*faulty[1:], *sound[:2]):
        memory, found = corrector.correct(memory, plan, model, box)
        assert found.executed_action.isfinite().all() and found.innovation.isfinite().all()
        memory = corrector.observe(memory, state)
    _, found = corrector.correct(memory, plan, model, box)
    assert all(part.isfinite().all() for part in found if part is not None)
