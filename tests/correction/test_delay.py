"""Commands that act late, or slowly."""

import pytest
import torch

from afm_rl.correction import ActionFlow
from afm_rl.correction.delay import align, command_acting, delay_tables, likeliest_delay
from afm_rl.regimes import Actuators


@pytest.mark.parametrize("late", [1, 3])
def test_a_command_joins_the_effect_that_came_later(late):
    age, count = torch.arange(6.0).unsqueeze(-1), torch.ones(6, 1)
    pairs = torch.cat([age, 100 + age, 0 * age, count, 0 * age], -1).expand(2, 6, 5)
    steps = torch.tensor([0, late])
    still, found = align(pairs, steps, 1)
    assert torch.equal(still, pairs[0])
    assert found[late:, 0].tolist() == list(range(6 - late)) and found[:, 3].sum() == 6 - late
    assert torch.equal(found[:, 1], pairs[1, :, 1])


def test_the_command_that_acts_is_so_many_steps_older_than_the_newest():
    commands = torch.arange(24.0).view(3, 4, 2)  # of four steps, the newest last
    found = command_acting(commands, torch.tensor([0, 1, 3]))
    assert torch.equal(found, torch.stack([commands[0, 3], commands[1, 2], commands[2, 0]]))
    assert torch.equal(command_acting(commands[0], torch.tensor(2)), commands[0, 1])


DELAYS = torch.tensor([0, -1, 1, 2, 2])  # nothing, one that takes any, late, late, late with a gain
TABLES = delay_tables(DELAYS, torch.tensor([1.0, 0.0, 0.0, 0.0, -2.0]).log_softmax(0))


@pytest.mark.parametrize(
    ("believed", "before", "late"),
    [
        (0, 0, 0),
        (1, 0, 0),
        (2, 0, 1),
        (3, 0, 2),
        (4, 0, 2),
        (1, 2, 2),  # what takes any delay keeps the one that was found
        (0, 2, 0),
        (2, 2, 1),
    ],
)
def test_the_delay_is_that_of_the_models_that_are_believed(believed, before, late):
    weights = torch.full((5, 2), 0.02)
    weights[believed] = 0.92
    assert likeliest_delay(weights, torch.tensor(before), *TABLES) == late
    batch = likeliest_delay(weights.expand(3, 5, 2), torch.full((3,), before), *TABLES)
    assert batch.tolist() == [late] * 3


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_nothing_has_changed_counts_what_it_is_worth_and_no_more_than_the_others(share):
    other = (1 - share) / 2
    told, first = delay_tables(torch.tensor([0, -1, 1]), torch.tensor([share, other, other]).log())
    counts = min(share, other)
    now, late = counts + other, other  # the second model takes any delay, at first none
    expected = torch.tensor([[counts / share / now, 1 / now, 0.0], [0.0, 0.0, 1 / late]])
    torch.testing.assert_close(told[0], expected)
    torch.testing.assert_close(first[0].exp(), torch.tensor([now, late]) / (now + late))


def test_no_axis_decides_alone_however_sure_it_is():
    sure = torch.tensor([1e-12, 1e-12, 1.0, 1e-12, 1e-12])
    others = torch.tensor([0.005, 0.005, 0.005, 0.98, 0.005])
    weights = torch.stack([sure, others, others], -1)
    assert likeliest_delay(weights[:, :2], torch.tensor(0), *TABLES) == 1
    assert likeliest_delay(weights, torch.tensor(0), *TABLES) == 2


def test_one_delay_is_found_from_the_evidence_of_all_axes():
    weights = torch.tensor([[0.05, 0.2], [0.05, 0.2], [0.6, 0.05], [0.25, 0.5], [0.05, 0.05]])
    assert likeliest_delay(weights[:, :1], torch.tensor(0), *TABLES) == 1
    assert likeliest_delay(weights, torch.tensor(0), *TABLES) == 2


def test_a_delay_that_was_found_stays_for_a_while():
    weights = torch.tensor([[0.05], [0.05], [0.5], [0.3], [0.1]])
    assert likeliest_delay(weights, torch.tensor(0), *TABLES) == 1
    assert likeliest_delay(weights, torch.tensor(2), *TABLES) == 2


@pytest.mark.parametrize("size", [1, 2, 6])
def test_while_the_delay_changes_nothing_is_corrected_nor_predicted(drive, line, plans, size):
    """Nobody knows which command will act next."""
    flow = ActionFlow(-torch.ones(size), torch.ones(size))
    actuators, planned = Actuators([-1.0] * size, [1.0] * size), plans(80, size)

    def effect(sent):
        if len(sent) == 11:
            actuators.fail({"random_delay": 3})
        return actuators(sent[-1]).float()

    (executed, *_), effects = drive(flow, line(size), effect, planned)
    assert (executed == planned).all(-1)[30:].float().mean() > 0.9
    assert (effects[11:] - executed[11:]).abs().mean() > 0.1
