"""The table of hypotheses."""

import math

import pytest
import torch
from harness import refused

from afm_rl.correction.hypotheses import (
    CHOICES,
    FILTER,
    HYPOTHESES,
    KINDS,
    NOMINAL,
    acting_of,
    choose,
)


def test_every_name_is_there_once_and_of_a_kind_that_is_computed():
    assert len({row.name for row in HYPOTHESES}) == len(HYPOTHESES)
    assert {row.kind for row in HYPOTHESES} == set(KINDS)


@pytest.mark.parametrize("by_place", [False, True])
def test_a_delayed_gain_comes_with_its_delay_and_readings_by_place_with_a_place(by_place):
    rows = choose(["near", "varied", "recent", "lag_1", "delay_3"], by_place, plain=-6.0)
    of = {kind: [row.name for row in rows if row.kind == kind] for kind in KINDS}
    assert of["network"] == ["recent", "varied", "near"][: 2 + by_place]
    assert [row.name for row in rows if row.is_late] == ["delay_3", "lag_1"]
    assert of["late_gain"] == ["gain_now", "gain_delay_3", "gain_lag_1"]
    priors = {row.name: row.log_prior for row in rows}
    assert priors["line"] == priors["gain_now"] == -6.0 and priors["reversed"] == 0.0
    assert priors["gain_lag_1"] == pytest.approx(-math.log(2))  # they share one


def test_without_names_all_are_chosen_up_to_the_longest_delay():
    assert len(choose(CHOICES, True, -6.0)) == len(HYPOTHESES)
    usual = [name for name in CHOICES if name != "newest"]
    assert choose(usual, True, -6.0) == choose(None, True, -6.0, 25)
    assert [max(row.delay for row in choose(None, True, -6.0, n)) for n in (0, 8, 25)] == [0, 8, 25]


@refused(
    ("recent", "expected a list of"),
    ([], "expected a list of"),
    (["late"], "'late': expected one of recent"),
    (["near", "delay_1"], "expected one by time"),
    says="corrector.hypotheses=.*{}",
)
def test_a_list_that_cannot_be_used_is_refused(names):
    choose(names, True, -6.0)


@pytest.mark.parametrize("lag", [1, 2, 3])
@pytest.mark.parametrize("delay", [0, 2])
def test_what_acts_follows_the_commands_as_a_low_pass_filter_does(lag, delay):
    commands = torch.rand(FILTER + delay, generator=torch.Generator().manual_seed(0))
    slow = commands[0]  # those before the oldest were the same
    for command in commands[1 : len(commands) - delay]:
        slow = command + math.exp(-1 / lag) * (slow - command)
    acting = acting_of([NOMINAL._replace(delay=delay, lag=lag)])
    torch.testing.assert_close((acting * commands).sum(), slow)
