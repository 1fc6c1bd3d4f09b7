"""What each reading reads in the memory."""

import math

import pytest
import torch

from afm_rl.correction.readings import (
    FILTER,
    READINGS,
    Reading,
    check_readings,
    lay_out,
    memory_of,
    read_rows,
)
from afm_rl.errors import ConfigurationError

MANY = 20
AGES = torch.arange(float(MANY)).unsqueeze(-1)
PLACE = torch.zeros(MANY, 2)
DELAYS = range(1, 9)
LONG = READINGS["long"]


def pairs_of(valid=None):
    """Return a memory of one action: 0, 1, ... with the effects 100, 101, ..."""
    valid = torch.ones(MANY, 1) if valid is None else valid
    return torch.cat([AGES, 100 + AGES, 0.01 * AGES, valid, 0 * AGES, PLACE], -1)


def read(reading, rows=4, pairs=None, away=None):
    """Return executed, effective, std and valid of what one reading reads, ``(K,)`` each."""
    timed = [READINGS["recent"]] if reading.near or reading.varied else []
    layout = lay_out([*timed, reading], rows)
    found = read_rows(pairs_of() if pairs is None else pairs, layout, 1, away, int(reading.varied))
    return [part[-1, :, 0] for part in found]


def without(*rows):
    valid = torch.ones(MANY, 1)
    valid[list(rows)] = 0.0
    return pairs_of(valid)


def test_recent_pairs_are_the_newest_and_fill_half():
    executed, effective, std, valid = read(READINGS["recent"])
    assert executed.tolist() == [0, 0, 18, 19] and effective.tolist() == [0, 0, 118, 119]
    torch.testing.assert_close(std, 0.01 * executed)
    assert valid.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("name", "filled"),
    [
        ("newest", 2),
        ("recent", 6),
        ("long", 12),
        ("varied", 12),
        ("here", 1),
        ("nearest", 2),
        ("near", 6),
    ],
)
def test_each_fills_its_share_and_one_row_at_least(name, filled):
    away = torch.zeros(MANY)
    assert read(READINGS[name], 12, away=away)[3].sum() == filled
    assert read(READINGS[name], 1, away=away)[3].sum() == 1


@pytest.mark.parametrize("delay", DELAYS)
def test_late_pairs_join_a_command_with_the_effect_that_came_later(delay):
    reading = READINGS[f"delay_{delay}"]._replace(share=1.0)
    executed, effective, std, valid = read(reading)
    assert effective.tolist() == [116, 117, 118, 119] and valid.all()
    assert torch.equal(executed, effective - 100 - delay)
    torch.testing.assert_close(std, 0.01 * (effective - 100))  # of the effect
    found = read(reading, pairs=without(17))[3]
    assert found.tolist() == [float(k not in (17, 17 + delay)) for k in range(16, 20)]


@pytest.mark.parametrize("lag", [1, 2, 3])
def test_slow_pairs_join_an_effect_with_the_commands_that_it_follows(lag):
    reading = READINGS[f"lag_{lag}"]._replace(share=1.0)
    executed, effective, std, valid = read(reading)
    assert effective.tolist() == [116, 117, 118, 119] and valid.all()
    for found, now in zip(executed, effective - 100, strict=True):
        slow = now - FILTER + 1  # the oldest command that it looks back on
        for command in range(int(slow) + 1, int(now) + 1):
            slow = command + math.exp(-1 / lag) * (slow - command)
        torch.testing.assert_close(found, slow)
    found = read(reading, pairs=without(MANY - 1 - FILTER))[3]
    assert found.tolist() == [0, 0, 0, 1]


def test_near_pairs_come_in_the_order_of_place_then_of_age():
    reading = READINGS["near"]._replace(share=1.0)
    away = torch.tensor([0.0, 4.0]).repeat(MANY // 2)  # every second pair is from elsewhere
    assert read(reading, away=away)[0].tolist() == [12, 14, 16, 18]
    away[18] = 9.0
    assert read(reading, away=away)[0].tolist() == [10, 12, 14, 16]
    away[16] = torch.inf  # as pairs that do not count have it
    assert read(reading, away=away)[0].tolist() == [8, 10, 12, 14]
    assert read(READINGS["nearest"], away=away)[0].tolist() == [0, 0, 0, 14]


def test_effects_from_before_a_change_are_read_by_place_only():
    valid = torch.full((MANY, 1), 0.5)
    valid[-3:] = 1.0
    executed, effective, _, counts = read(LONG, rows=4, pairs=pairs_of(valid))
    assert counts.tolist() == [0, 1, 1, 1] and executed.tolist() == [0, 17, 18, 19]
    # A command from before it may act after it.
    executed, effective, _, counts = read(READINGS["delay_2"], rows=8, pairs=pairs_of(valid))
    assert counts[-3:].tolist() == [1, 1, 1] and counts.sum() == 3
    assert executed[-3:].tolist() == [15, 16, 17] and effective[-3:].tolist() == [117, 118, 119]
    near = read(READINGS["near"], rows=8, pairs=pairs_of(valid), away=torch.arange(float(MANY)))
    assert near[3].tolist() == [0, 0, 0, 0, 1, 1, 1, 1] and near[0][-1] == 0


def test_what_does_not_count_fills_a_row_with_nothing():
    few = pairs_of((AGES > MANY - 2).float())
    for reading in (LONG, READINGS["near"]._replace(share=1.0), READINGS["varied"]):
        executed, effective, _, valid = read(reading, pairs=few, away=torch.zeros(MANY))
        assert valid.tolist() == [0, 0, 0, 1] == (executed > 0).tolist() == (effective > 0).tolist()


@pytest.mark.parametrize(("delay", "lag"), [(0, 0.0), (3, 0.0), (8, 0.0), (0, 2.0), (3, 1.0)])
def test_the_memory_is_as_long_as_they_look_back_and_no_longer(delay, lag):
    reading = Reading(share=1.0, delay=delay, lag=lag)
    count = memory_of([reading], 3)
    assert read(reading, 3, pairs_of()[-count:])[3].all()
    with pytest.raises((RuntimeError, IndexError)):
        read(reading, 3, pairs_of()[-count + 1 :])


@pytest.mark.parametrize("axes", [1, 2, 6])
def test_batches_are_read_one_by_one(axes):
    generator = torch.Generator().manual_seed(0)
    pairs = torch.rand(5, MANY, 3 * axes + 4, generator=generator)
    away = torch.rand(5, MANY, generator=generator)
    chosen = [READINGS[name] for name in check_readings(list(READINGS), by_place=True)]
    layout = lay_out(chosen, 4)
    together = read_rows(pairs, layout, axes, away)
    assert together.executed.shape == (5, len(chosen), 4, axes)
    for k in range(5):
        single = read_rows(pairs[k], layout, axes, away[k])
        assert all(torch.equal(one, many[k]) for one, many in zip(single, together, strict=True))


def test_those_by_place_are_last():
    mixed = ["near", "varied", "recent", "here", "delay_3"]
    assert check_readings(mixed, by_place=True) == ["recent", "delay_3", "varied", "near", "here"]
    assert check_readings(["near", "recent"], by_place=False) == ["recent"]


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        ("recent", "expected a list of"),
        ([], "expected a list of"),
        (["late"], "'late': expected one of recent"),
        (["near"], "expected one by time"),
    ],
    ids=str,
)
def test_a_list_that_cannot_be_used_is_refused(names, complaint):
    with pytest.raises(ConfigurationError, match=f"corrector.readings=.*{complaint}"):
        check_readings(names, by_place=True)


def test_varied_pairs_are_the_newest_and_those_farthest_from_all_of_them():
    pairs = pairs_of()
    pairs[:, 0] = torch.tensor([5.0, 0.0] + [1.0] * 15 + [-2.0] + [1.0] * 2)
    assert read(READINGS["varied"], pairs=pairs)[0].tolist() == [5, 0, -2, 1]
    pairs[:, 0] = 1.0  # all alike: the newest
    assert read(READINGS["varied"], pairs=pairs)[1].tolist() == [116, 117, 118, 119]


def test_varied_pairs_are_from_after_the_change_and_none_counts_twice():
    pairs = pairs_of()
    pairs[:-2, 3] = 0.5
    executed, _, _, valid = read(READINGS["varied"], pairs=pairs)
    assert sorted(executed.tolist()) == [0, 0, 18, 19] and valid.sum() == 2
