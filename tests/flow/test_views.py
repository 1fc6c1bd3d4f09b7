"""How a memory of pairs is read."""

import pytest
import torch

from afm_rl.flow.recall import Pairs, look
from afm_rl.flow.views import VIEWS, View, lay_out, memory_of

AGES = torch.arange(12.0).unsqueeze(-1)
PAIRS = Pairs(AGES, 100 + AGES, torch.ones(12, 1))


def rows_of(view, rows=4, pairs=PAIRS, away=None):
    """Return executed, effective and valid of what one view shows, ``(K,)`` each."""
    shown = look(pairs, lay_out([view], rows), away)
    assert shown.shape == (1, 3 * rows)
    return shown[0].unflatten(-1, (rows, 3)).unbind(-1)


def test_recent_pairs_are_the_newest_and_fill_half():
    executed, effective, valid = rows_of(VIEWS["recent"])
    assert executed.tolist() == [0, 0, 10, 11] and effective.tolist() == [0, 0, 110, 111]
    assert valid.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("name", "filled"),
    [("newest", 2), ("recent", 6), ("long", 12), ("here", 1), ("nearest", 2), ("near", 6)],
)
def test_views_fill_their_share_and_one_row_at_least(name, filled):
    pairs = Pairs(*(part.repeat(2, 1) for part in PAIRS))
    assert rows_of(VIEWS[name], 12, pairs, torch.zeros(24))[2].sum() == filled
    assert rows_of(VIEWS[name], 1, pairs, torch.zeros(24))[2].sum() == 1


def test_means_halve_the_noise_of_twice_as_many():
    executed, effective, valid = rows_of(VIEWS["mean"])
    assert executed.tolist() == [4.5, 6.5, 8.5, 10.5] and (effective == executed + 100).all()
    some = PAIRS._replace(valid=PAIRS.valid.clone())
    some.valid[7] = 0.0
    executed, _, valid = rows_of(VIEWS["mean"], pairs=some)
    assert valid.tolist() == [1, 0, 1, 1] and executed[1] == 0  # both must count


@pytest.mark.parametrize("late", [1, 2])
def test_late_pairs_join_a_command_with_the_effect_that_came_later(late):
    view = VIEWS[f"late_{late}"]._replace(share=1.0)
    executed, effective, valid = rows_of(view)
    assert effective.tolist() == [108, 109, 110, 111] and valid.all()
    assert torch.equal(executed, effective - 100 - late)
    some = PAIRS._replace(valid=PAIRS.valid.clone())
    some.valid[9] = 0.0
    assert rows_of(view, pairs=some)[2].tolist() == [
        float(k not in (9, 9 + late)) for k in range(8, 12)
    ]


def test_near_pairs_come_in_the_order_of_place_then_of_age():
    view = VIEWS["near"]._replace(share=1.0)
    away = torch.tensor([0.0, 4.0]).repeat(6)  # every second pair is from elsewhere
    assert rows_of(view, away=away)[0].tolist() == [4, 6, 8, 10]
    away[10] = 9.0
    assert rows_of(view, away=away)[0].tolist() == [2, 4, 6, 8]
    some = PAIRS._replace(valid=PAIRS.valid.clone())
    some.valid[8] = 0.0
    assert rows_of(view, pairs=some, away=away)[0].tolist() == [0, 2, 4, 6]
    assert rows_of(VIEWS["nearest"], away=away)[0].tolist() == [0, 0, 0, 8]


def test_what_does_not_count_fills_a_row_with_nothing():
    few = PAIRS._replace(valid=(AGES > 10).float())
    for name in ("long", "near"):
        view = VIEWS[name]._replace(share=1.0)
        executed, effective, valid = rows_of(view, pairs=few, away=torch.zeros(12))
        assert valid.tolist() == [0, 0, 0, 1] == (executed > 0).tolist() == (effective > 0).tolist()


def test_a_view_by_place_needs_places():
    with pytest.raises(ValueError, match="needs distances"):
        look(PAIRS, lay_out([VIEWS["near"]], 4))


@pytest.mark.parametrize("view", [*VIEWS.values(), View(share=1.0, merge=3), View(late=5)])
def test_the_memory_is_as_long_as_views_look_back_and_no_longer(view):
    count = memory_of([view], 3)
    pairs = Pairs(*(part[:count] for part in PAIRS))
    look(pairs, lay_out([view], 3), torch.zeros(count))
    if not view.near and (view.late or view.merge > 1):
        with pytest.raises((RuntimeError, IndexError, ValueError)):
            look(Pairs(*(part[1:] for part in pairs)), lay_out([view], 3))


def test_batches_are_read_row_by_row():
    generator = torch.Generator().manual_seed(0)
    pairs = Pairs(
        *(torch.rand(2, 3, 9, 2, generator=generator) for _ in range(2)), torch.ones(2, 3, 9, 1)
    )
    away = torch.rand(2, 3, 9, generator=generator)
    layout = lay_out(list(VIEWS.values()), 4)
    together = look(pairs, layout, away)
    assert together.shape == (2, 3, len(VIEWS), 20)
    for k in range(2):
        for i in range(3):
            single = look(Pairs(*(part[k, i] for part in pairs)), layout, away[k, i])
            assert torch.equal(single, together[k, i])


@pytest.mark.parametrize("merges", [(1, 2), (1, 3), (2, 3)])
def test_views_that_average_differently_stand_side_by_side(merges):
    views = [View(share=1.0, merge=merge) for merge in merges]
    together = look(PAIRS, lay_out(views, 4))
    for view, shown in zip(views, together, strict=True):
        torch.testing.assert_close(shown, look(PAIRS, lay_out([view], 4))[0])
        executed = shown.unflatten(-1, (4, 3))[:, 0]
        expected = AGES[-4 * view.merge :, 0].unflatten(0, (4, view.merge)).mean(-1)
        torch.testing.assert_close(executed, expected)
