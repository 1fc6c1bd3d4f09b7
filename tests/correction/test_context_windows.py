"""What each reading reads in the memory."""

import pytest
import torch

from afm_rl.correction import context_windows
from afm_rl.correction.context_windows import ContextWindow, ContextWindows

MANY = 20
AGES = torch.arange(float(MANY)).unsqueeze(-1)
PLACE = torch.zeros(MANY, 1)


def pairs_of(valid=None, place=PLACE):
    """Return a memory of one action: 0, 1, ... with the effects 100, 101, ..."""
    valid = torch.ones(MANY, 1) if valid is None else valid
    return torch.cat([AGES, 100 + AGES, 0.01 * AGES, valid, 0 * AGES, place], -1)


def read(name, rows=4, pairs=None):
    """Return executed, effective, std and valid of what one reading reads, ``(K,)`` each.

    Here is where the place is 0.
    """
    pairs = pairs_of() if pairs is None else pairs
    return [part[0, :, 0] for part in ContextWindows([name], rows, 1)(pairs, torch.zeros(1))]


@pytest.fixture
def whole(monkeypatch):
    """Let windows by place fill all rows."""
    monkeypatch.setitem(context_windows.CONTEXT_WINDOWS, "near", ContextWindow("near", share=1.0))


def test_recent_pairs_are_the_newest_and_fill_half():
    executed, effective, std, valid = read("recent")
    assert executed.tolist() == [0, 0, 18, 19] and effective.tolist() == [0, 0, 118, 119]
    torch.testing.assert_close(std, 0.01 * executed)
    assert valid.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("name", "filled"),
    [
        ("newest", 2),
        ("recent", 6),
        ("varied", 12),
        ("here", 1),
        ("nearest", 2),
        ("near", 6),
    ],
)
def test_each_fills_its_share_and_one_row_at_least(name, filled):
    assert read(name, 12)[3].sum() == filled
    assert read(name, 1)[3].sum() == 1


def test_near_pairs_come_in_the_order_of_place_then_of_age(whole):
    place = torch.tensor([0.0, 2.0]).repeat(MANY // 2).unsqueeze(-1)  # every second is elsewhere
    assert read("near", pairs=pairs_of(place=place))[0].tolist() == [12, 14, 16, 18]
    place[18] = 3.0
    assert read("near", pairs=pairs_of(place=place))[0].tolist() == [10, 12, 14, 16]
    valid = torch.ones(MANY, 1)
    valid[16] = 0.0
    assert read("near", pairs=pairs_of(valid, place))[0].tolist() == [8, 10, 12, 14]
    assert read("nearest", pairs=pairs_of(valid, place))[0].tolist() == [0, 0, 0, 14]


def test_effects_from_before_a_change_are_read_by_place_only():
    valid = torch.full((MANY, 1), 0.5)
    valid[-3:] = 1.0
    executed, effective, _, counts = read("varied", pairs=pairs_of(valid))
    assert counts.tolist() == [0, 1, 1, 1] and executed.tolist() == [0, 17, 18, 19]
    near = read("near", 8, pairs_of(valid, place=AGES))
    assert near[3].tolist() == [0, 0, 0, 0, 1, 1, 1, 1] and near[0][-1] == 0


@pytest.mark.parametrize("name", ["recent", "near", "varied"])
def test_what_does_not_count_fills_a_row_with_nothing(name, whole):
    few = pairs_of((AGES > MANY - 2).float())
    executed, effective, _, valid = read(name, pairs=few)
    assert valid.tolist() == [0, 0, 0, 1] == (executed > 0).tolist() == (effective > 0).tolist()


def test_varied_pairs_are_the_newest_and_those_farthest_from_all_of_them():
    pairs = pairs_of()
    pairs[:, 0] = torch.tensor([5.0, 0.0] + [1.0] * 15 + [-2.0] + [1.0] * 2)
    assert read("varied", pairs=pairs)[0].tolist() == [5, 0, -2, 1]
    pairs[:, 0] = 1.0  # all alike: the newest
    assert read("varied", pairs=pairs)[1].tolist() == [116, 117, 118, 119]


def test_varied_pairs_are_from_after_the_change_and_none_counts_twice():
    pairs = pairs_of()
    pairs[:-2, 3] = 0.5
    executed, _, _, valid = read("varied", pairs=pairs)
    assert sorted(executed.tolist()) == [0, 0, 18, 19] and valid.sum() == 2
