"""The windows that a context flow is trained on."""

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.flow.counterfactuals import excite, imagine, rows_filled, rows_of_now

MANY = 4000


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("window", [1, 4, 12])
def test_windows_are_filled_as_views_fill_them_or_by_any_number(window, generator):
    filled = rows_filled(MANY, window, generator)
    assert filled.shape == (MANY, 1) and filled.min() >= 1 and filled.max() <= window
    share = torch.bincount(filled.flatten(), minlength=window + 1) / MANY
    expected = torch.zeros(window + 1)
    expected[1:] += 0.25 / window
    for usual in (max(1, round(window / 6)), max(1, window // 2), window):
        expected[usual] += 0.25
    torch.testing.assert_close(share, expected, rtol=0, atol=0.03)


def test_half_of_the_windows_are_from_one_regime(generator):
    now = rows_of_now(MANY, 6, generator)
    assert now.min() == 1 and now.max() == 6
    assert float((now == 6).float().mean()) == pytest.approx(0.5 + 0.5 / 6, abs=0.03)


def test_actions_move_about_everywhere_or_about_one_and_saturate(generator):
    executed = excite(MANY, 12, 2, generator)
    assert executed.shape == (MANY, 12, 2) and executed.abs().max() == 1
    narrow = (executed.amax(1) - executed.amin(1) < 0.81).all(-1)
    assert float(narrow.float().mean()) == pytest.approx(0.5, abs=0.03)
    stuck = (executed.abs() == 1).float()
    assert 0.25 < float(stuck[narrow].mean()) < 0.5 and not stuck[~narrow].mean() > 0.02
    held = (executed.abs() == 1).all(1)  # the same command all the time: what full drive looks like
    assert float(held[narrow].float().mean()) > 0.2


def test_beyond_the_box_effects_go_on_straight(box, generator, make_ensemble):
    low, high = box
    state, effect = torch.zeros(50, 3), 2.5 * high.expand(50, 2)
    seen = imagine(Dubins(), state, effect, low, high, generator)
    expected = torch.tensor([0.5, 0.0, 0.75]).expand(50, 3)
    torch.testing.assert_close(seen, expected, rtol=0, atol=5e-3)
    spread = (seen - expected).std(0)
    torch.testing.assert_close(spread, torch.full((3,), 1e-3), rtol=0.5, atol=0)
    model = make_ensemble()
    model.noise_scale = lambda state, action: torch.zeros_like(state)
    model.forecast = lambda state, action: (model(state, action), torch.zeros_like(state))
    once, twice = (
        imagine(model, state, k * high.expand(50, 2), low, high, generator) for k in (2, 3)
    )
    edge = model(state, high.expand(50, 2))
    torch.testing.assert_close(twice - edge, 2 * (once - edge), rtol=1e-3, atol=1e-4)
