"""What the correction can do of faults, whatever the number of actuators.

A point that moves by its action, in 1 to 17 dimensions, closed loop, from the first step.
"""

import math

import pytest
import torch
from effects import before, flow_of, half_reversed

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins

SIZES = [2, *(pytest.param(size, marks=pytest.mark.slow) for size in (1, 6, 17))]
STEPS, MANY = 20, 56
ENOUGH = {"gains": 20, "two swapped": 48}  # steps; of all others 8


def gains(sent):
    return -half_reversed(sent) * torch.linspace(0.6, 1.6, sent[-1].shape[-1])


REGIMES = {
    "reversed": lambda sent: -sent[-1],
    "half reversed": half_reversed,
    "gains": gains,
    "bias": lambda sent: sent[-1] + 0.25,
    "two swapped": lambda sent: torch.cat([sent[-1][..., :2].flip(-1), sent[-1][..., 2:]], -1),
}


def miss_of(effects, planned, steps):
    """Return the root mean square miss of plans from a step on, by mission and axis."""
    return (effects - planned)[steps:].square().mean(0).sqrt()


FAULTS = [pytest.param(name, 2, id=name) for name in REGIMES]
FAULTS += [
    pytest.param(name, size, id=f"{name} {size}", marks=pytest.mark.slow)
    for name in REGIMES
    for size in (1, 6, 17)
    if (name, size) != ("two swapped", 1)
]


@pytest.mark.parametrize(("name", "size"), FAULTS)
def test_faults_are_corrected_within_few_steps(line, drive, plans, name, size):
    planned = plans(MANY, 4, size, size=0.5)
    found, effects = drive(flow_of(size), line(size), REGIMES[name], planned)
    after = ENOUGH.get(name, 8)
    idle = (REGIMES[name]([planned[after:]]) - planned[after:]).square().mean().sqrt()
    miss = miss_of(effects, planned, after)
    assert miss.median() < 0.05 and miss.square().mean().sqrt() < 0.35 * idle
    foreseen = (found.predicted_effect - effects)[after:].square().mean().sqrt()
    assert foreseen < 0.12


@pytest.mark.parametrize("size", SIZES)
def test_reversed_actuators_do_as_planned_from_the_third_step_on(line, drive, plans, size):
    planned = plans(8, 32, size, size=0.5)
    _, effects = drive(flow_of(size), line(size), REGIMES["reversed"], planned)
    assert torch.equal(effects[:2], -planned[:2])  # of the first step alone nothing is concluded
    right = (effects - planned)[2:].abs() < 0.05 + 0.1 * planned[2:].abs()
    assert right.float().mean() > 0.85


@pytest.mark.parametrize("size", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 6))])
def test_a_robot_that_needs_little_of_its_actuators_is_corrected(line, drive, plans, size):
    """As a quadrotor that hovers, whose moments are hundredths of what they can be."""
    planned, change = plans(136, 8, size, size=0.01), 40

    def effect(sent):
        return sent[-1] if len(sent) <= change else half_reversed(sent)

    _, effects = drive(flow_of(size), line(size, 1e-5), effect, planned)
    assert torch.equal(effects[:change], planned[:change])
    assert miss_of(effects, planned, change + 64).median() < 0.25 * 0.01


@pytest.mark.parametrize("name", ["bias", "two swapped"])
def test_what_one_map_explains_is_undone_exactly(line, drive, plans, name):
    planned = plans(MANY, 8, 3, size=0.5)
    _, effects = drive(flow_of(3), line(3), REGIMES[name], planned)
    assert miss_of(effects, planned, 36).median() < 5e-4


@pytest.mark.parametrize("size", [1, 2])
def test_small_actions_that_look_reversed_at_first_are_understood(line, drive, plans, size):
    """One pair does not tell an offset from a reversal: the next ones count, and no old ones."""
    planned = plans(40, 24, size, size=0.15, seed=1)

    def weak_and_biased(sent):
        return sent[-1] if len(sent) <= 10 else 0.5 * sent[-1] + 0.2

    _, effects = drive(flow_of(size), line(size, noise_std=0.004), weak_and_biased, planned)
    assert (effects - planned)[30:].abs().quantile(0.9) < 0.05


@pytest.mark.parametrize("delay", [1, 4])
def test_late_commands_of_a_slow_plan_are_no_offset(line, drive, delay):
    time, phase = torch.arange(40.0)[:, None, None], torch.linspace(0, 6, 16)[:, None]
    planned, begins = 0.8 * torch.sin(6.28 * time / 80 + phase), 10

    def late(sent):
        return sent[-1 - (delay if len(sent) > begins else 0)]

    found, _ = drive(flow_of(1), line(1), late, planned)
    assert (found.executed_action - planned)[begins + 5 :].abs().quantile(0.9) < 0.05


def test_swapped_commands_of_a_gait_are_not_taken_for_late_ones(line, drive):
    """A quarter of a period late, each of two axes looks like the other."""
    time, phase = torch.arange(120.0)[:, None, None], torch.tensor([0.0, 1.57])
    start = torch.linspace(0, 6, 12)[:, None]
    planned = 0.6 * torch.sin(6.28 * time / 24 + phase + start)
    _, effects = drive(flow_of(2), line(2), REGIMES["two swapped"], planned)
    assert miss_of(effects, planned, 60).median() < 0.05


@pytest.mark.parametrize("size", [2, 6])
def test_what_was_learnt_before_a_rest_is_known_after_it(line, drive, plans, size):
    moving = plans(16, 24, size, size=0.6)
    rest = torch.linspace(-0.3, 0.3, size).expand(20, 24, size)
    generator = torch.Generator().manual_seed(0)

    def swapped(sent):
        return sent[-1].roll(1, -1) + 0.01 * torch.randn(sent[-1].shape, generator=generator)

    planned = torch.cat([moving, rest, moving[:1]])
    _, effects = drive(flow_of(size), line(size), swapped, planned)
    assert (effects - planned)[-1].abs().median() < 0.05


@pytest.mark.parametrize("delay", [1, 3])
def test_late_commands_of_a_reversed_motor_are_found(line, drive, plans, delay):
    planned = plans(4, 8, 2, size=0.5).repeat_interleave(12, 0)  # steady for a while
    _, effects = drive(flow_of(2), line(2), lambda sent: -before(sent, delay), planned)
    settled = torch.arange(48) % 12 >= 10
    settled[:24] = False
    assert (effects - planned)[settled].abs().median() < 0.08


def test_what_waits_by_a_known_delay_has_the_effects_that_are_believed(line, plans):
    """Two steps late, which is known, and reversed, which is estimated."""
    flow, model, planned = flow_of(2, delay=2), line(2), plans(30, 8, 2)
    box = torch.tensor([[-1.0, -1.0], [1.0, 1.0]]).expand(8, 2, 2)
    state, waiting = torch.zeros(8, 2), [torch.zeros(8, 2)] * 2
    memory = flow.begin(state)
    for plan in planned:
        memory, found = flow.correct(memory, plan, model, box)
        effects, steps = flow.under_way(memory), flow.delay_in(memory)
        waiting.append(found.executed_action)
        state = model(state, -waiting.pop(0))
        memory = flow.observe(memory, state)
    assert (steps == 2).all()
    to_come = torch.stack(waiting, 1)
    assert (effects[:, -2:] + to_come).abs().median() < 0.02


@pytest.mark.parametrize(
    ("lag", "share", "gain"), [(1.0, 0.3, 1.0), (3.0, 0.5, -1.0), (1.5, 0.7, -1.0)]
)
def test_slow_actuators_are_led(line, drive, plans, lag, share, gain):
    """What acts follows commands with a time constant; slow plans are within its reach.

    Lags of 1 and 3 steps are readings, one of 1.5 is between them.
    """
    keep, phase = math.exp(-1 / lag), 6 * plans(1, 24, 2)
    planned = 0.5 * (0.2 * torch.arange(60)[:, None, None] + phase).sin()

    def slow(sent):
        now = 0.0
        for command in sent:
            now = keep * now + (1 - keep) * command
        return gain * now

    _, effects = drive(flow_of(2), line(2), slow, planned)
    alone = torch.stack([slow(planned[: k + 1]) for k in range(len(planned))])
    miss, usual = ((e - planned)[30:].abs().mean() for e in (effects, gain * alone))
    assert miss < share * usual


def test_a_limited_rate_is_no_reason_to_correct(line, drive, plans):
    planned = plans(48, 24, 2, size=0.9)

    def limited(sent):
        now = torch.zeros_like(sent[0])
        for command in sent:
            now = now + (command - now).clamp(-0.2, 0.2)
        return now

    found, _ = drive(flow_of(2), line(2), limited, planned)
    assert (found.executed_action == planned)[12:].float().mean() > 0.95


@pytest.mark.parametrize("size", SIZES)
def test_noise_alone_is_not_worth_a_correction(line, drive, plans, size):
    planned = plans(STEPS, 24, size)
    generator = torch.Generator().manual_seed(0)

    def noisy(sent):
        return sent[-1] + 0.1 * torch.randn(sent[-1].shape, generator=generator)

    _, effects = drive(flow_of(size), line(size), noisy, planned)
    assert miss_of(effects, planned, 8).square().mean().sqrt() < 1.6 * 0.1


def test_a_noisy_reversed_robot_is_corrected(line, drive, plans):
    planned = plans(STEPS, 16, 2, size=0.5)
    flow, model = flow_of(2), line(2, noise_std=0.03)
    _, effects = drive(flow, model, lambda sent: -sent[-1], planned, noise=0.03)
    assert (effects - planned)[8:].abs().median() < 0.08


def test_an_outlier_does_little_harm(line, drive, plans):
    planned = plans(STEPS, 8, 2, size=0.5)

    def wild(sent):
        return -sent[-1] + (1.0 if len(sent) == 12 else 0.0)

    _, effects = drive(flow_of(2), line(2), wild, planned)
    assert (effects - planned)[13:].abs().median() < 0.06


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_bounds_say_what_can_be_had(line, drive, plans, gain):
    found, _ = drive(flow_of(2), line(2), lambda sent: gain * sent[-1], plans(12, 4, 2, size=0.4))
    low, high = found.effect_bounds[-1].unbind(-2)
    if gain > 1:
        torch.testing.assert_close(high, torch.full((4, 2), gain), rtol=0.25, atol=0)
        torch.testing.assert_close(low, torch.full((4, 2), -gain), rtol=0.25, atol=0)
    else:  # never less than what can be had, and little more than the box
        assert (torch.stack([high, -low]) > 0.9 * gain).all()
        assert (torch.stack([high, -low]) < 1.5).all()


@pytest.mark.parametrize(("mode", "weak"), [("clip", 0.5), ("clip", 0.0), ("mixed", 0.5)])
def test_bounds_say_what_has_become_unavailable(line, drive, plans, mode, weak):
    """The first axis is weak or dead; the second one is healthy."""
    factor = torch.tensor([weak, 1.0])
    flow, planned = flow_of(2, saturation=mode), plans(24, 4, 2, size=1.0)
    found, _ = drive(flow, line(2), lambda sent: factor * sent[-1], planned)
    low, high = found.effect_bounds[-1].unbind(-2)
    assert (high[:, 0] < weak + 0.3).all() and (low[:, 0] > -weak - 0.3).all()
    assert (high[:, 1] > 0.9).all() and (low[:, 1] < -0.9).all()


@pytest.mark.parametrize("mode", ["clip", "mixed"])
def test_an_axis_without_influence_does_not_stop_the_others(line, drive, plans, mode):
    factor, planned = torch.tensor([0.0, -1.0]), plans(24, 64, 2, size=0.8)
    flow = flow_of(2, saturation=mode)
    _, effects = drive(flow, line(2), lambda sent: factor * sent[-1], planned)
    miss = miss_of(effects[..., 1], planned[..., 1], 16)
    assert miss.median() < 0.01 and (miss < 0.1).float().mean() > 0.95


def test_where_plans_are_done_slower_they_may_ask_for_more(line, drive, plans):
    factor = torch.tensor([0.1, 1.0])
    flow, planned = flow_of(2, saturation="mixed"), plans(24, 4, 2, size=1.0)
    found, _ = drive(flow, line(2), lambda sent: factor * sent[-1], planned)
    low, high = found.effect_bounds[-1].unbind(-2)
    assert (high > 0.9999).all() and (low < -0.9999).all()


@pytest.mark.parametrize("gain", [-1.3, -0.7])
def test_a_robot_crosses_ground_that_drives_it_back(gain):
    """A correction that forgets the ground beyond the edge would be thrown back for ever."""
    box, plan = torch.tensor([[-1.0, -1.0], [1.0, 1.0]]), torch.tensor([[1.0, 0.0]])
    flow, model, state = ActionFlow(*box, context_coordinates=[0, 1]), Dubins(), torch.zeros(1, 3)
    memory = flow.begin(state)
    for _ in range(80):
        memory, answer = flow.correct(memory, plan, model, box.unsqueeze(0))
        effect = answer.executed_action.clone()
        if 1.0 < state[0, 0] < 3.0:
            effect[:, 0] *= gain
        state = model(state, effect)
        memory = flow.observe(memory, state)
    assert state[0, 0] > 4.0
