"""What least squares and the nearest pairs tell a flow."""

import pytest
import torch

from afm_rl.flow.hints import ANSWERS, FITS, MISSES, NEAR, fit_window
from afm_rl.flow.least_squares import apply_friction, fit_friction, invert_friction
from afm_rl.flow.saturation import LIMIT

AXIS = torch.linspace(-1, 1, 5)
ASKED = torch.cartesian_prod(AXIS, AXIS)
EXECUTED = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7], [0.4, 0.9], [0.6, -1]])
ONES = torch.ones(len(EXECUTED), 1)
FRICTION = 2  # place of the fit
DEAD = torch.tensor([0.55, 0.5])  # of some of these actions nothing is left
MAPS = {
    "gain": (lambda u: torch.tensor([-1.6, 1.3]) * u, range(FITS)),
    "small gain": (lambda u: torch.tensor([0.05, -0.3]) * u, (0, 1)),
    "friction": (lambda u: u - 0.3 * u.sign(), (FRICTION,)),
    "dead zone": (lambda u: u - u.clamp(-DEAD, DEAD), (FRICTION,)),
    "affine": (lambda u: u @ torch.tensor([[0.6, 0.8], [-0.8, 0.6]]) + 0.1, (3,)),
}


def answers(found):
    """Return what is answered ``(*B, 6, 2)``."""
    assert found.shape[-1] == 2 * ANSWERS
    return found.unflatten(-1, (ANSWERS, 2))


@pytest.fixture(params=MAPS)
def example(request):
    """A map, its window, and the fits that are exact for it."""
    regime, exact = MAPS[request.param]
    return regime, fit_window(EXECUTED, regime(EXECUTED), ONES), exact


def test_effects_are_exact_where_a_fit_can_express_them(example):
    regime, fits, exact = example
    found = answers(fits.wide().effect(ASKED))
    for k in exact:
        asked = ASKED.abs() > 0  # at rest nothing moves, whatever friction would do to it
        miss = (found[:, k] - regime(ASKED))[asked].abs().max()
        assert miss < (0.08 if k == FRICTION else 0.03)


def test_actions_are_exact_where_a_fit_can_express_them(example):
    regime, fits, exact = example
    planned = regime(ASKED[(ASKED != 0).all(-1)])
    planned = planned[(planned.abs() > 0.01).all(-1)]
    found = answers(fits.wide().execute(planned, "clip"))
    for k in exact:
        assert found[:, k].abs().max() <= 1
        torch.testing.assert_close(regime(found[:, k]), planned, rtol=0.05, atol=0.06)


def test_each_explains_what_it_can_express(example):
    _, fits, exact = example
    misses = fits.misses.view(MISSES, 2).mean(-1)
    assert fits.misses.shape == (2 * MISSES,) and misses.argmin().item() in exact
    assert (misses[list(exact)] < -3.5).all()


@pytest.mark.parametrize("saturation", ["direction", "clip", "mixed"])
def test_what_cannot_be_had_gives_way_as_it_is_told(saturation):
    fits = fit_window(EXECUTED, 0.2 * EXECUTED, ONES)
    found = answers(fits.execute(torch.tensor([0.8, 0.4]), saturation))
    expected = torch.tensor([1.0, 1.0] if saturation == "clip" else [1.0, 0.5])
    torch.testing.assert_close(found[:2], expected.expand(2, 2), rtol=0, atol=0.03)


def test_pairs_without_effect_tell_nothing_of_friction():
    gain, offset = torch.tensor([1.0, 1.0]), torch.tensor([-0.55, -0.5])
    effective = MAPS["dead zone"][0](EXECUTED)
    assert 0 < (effective == 0).sum() < effective.numel() / 2  # some are held
    fitted = fit_friction(EXECUTED, effective, ONES)
    torch.testing.assert_close(fitted[0], gain, rtol=0, atol=0.1)
    torch.testing.assert_close(fitted[1], offset, rtol=0, atol=0.1)
    torch.testing.assert_close(apply_friction(gain, offset, EXECUTED), effective)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_friction_is_overcome(sign):
    gain, offset = torch.tensor([-0.8, 1.2]), sign * torch.tensor([0.2, -0.3])
    effective = gain * EXECUTED + offset * EXECUTED.sign()
    fitted = fit_friction(EXECUTED, effective, ONES)
    torch.testing.assert_close(fitted[0], gain, rtol=0, atol=0.05)
    torch.testing.assert_close(fitted[1], offset, rtol=0, atol=0.05)
    wanted = torch.tensor([0.5, -0.7])
    action = invert_friction(gain, offset, wanted)
    torch.testing.assert_close(gain * action + offset * action.sign(), wanted)


def test_the_nearest_pairs_answer_what_no_fit_can():
    executed = torch.linspace(-1, 1, 9).unsqueeze(-1)
    effective = executed.abs() * (1 - executed.abs())  # two actions for each effect
    fits = fit_window(executed, effective, torch.ones(9, 1)).wide()
    asked = executed[[0, 3, 6]]
    worth, nearness = fits.effect(asked).split([FITS + 1, 1], -1)
    torch.testing.assert_close(worth[:, -1:], effective[[0, 3, 6]], rtol=0, atol=0.04)
    assert (nearness > 0.3).all()
    tried, came = fits.execute(effective[[0, 6]], "clip").split([FITS, 1, 1], -1)[1:]
    torch.testing.assert_close(came, effective[[0, 6]], rtol=0, atol=0.1)
    assert tried.abs().max() <= 1


def test_near_is_near_on_each_axis_for_itself():
    executed = torch.tensor([[0.8, -0.8], [-0.8, 0.8]])
    effective = torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    fits = fit_window(executed, effective, torch.ones(2, 1))
    worth, nearness = answers(fits.effect(torch.tensor([0.8, 0.8])))[FITS:]
    torch.testing.assert_close(worth, torch.tensor([0.1, 0.4]), rtol=0, atol=1e-4)
    assert (nearness > 0.89).all()
    close, further, far = (
        answers(fits.effect(torch.tensor([x, 0.8])))[-1, 0] for x in (0.7, 0.8 - NEAR, 0.0)
    )
    assert 0.89 > close > further > far and far < 1e-6
    assert further == pytest.approx(0.9 / 2.718, abs=1e-3)  # of the older one, at one length


def test_the_newer_of_two_equals_counts_more():
    executed = torch.full((2, 1), 0.5)
    fits = fit_window(executed, torch.tensor([[0.0], [1.0]]), torch.ones(2, 1))
    assert fits.effect(torch.tensor([0.5]))[FITS] == pytest.approx(1 / 1.9, abs=1e-3)


def test_knowing_nothing_the_plan_is_believed():
    fits = fit_window(torch.zeros(6, 2), torch.zeros(6, 2), torch.zeros(6, 1)).wide()
    for found in (fits.execute(ASKED, "direction"), fits.effect(ASKED)):
        believed = answers(found)[:, :FITS]
        expected = ASKED.unsqueeze(-2).expand(-1, FITS, -1)
        torch.testing.assert_close(believed, expected, rtol=0, atol=1e-3)
    assert (answers(fits.effect(ASKED))[:, -1] < 1e-4).all()  # nothing is near


def test_pairs_that_do_not_count_do_not_count():
    count = torch.tensor([0.0, 1, 1, 1, 1, 1]).unsqueeze(-1)
    wrong = EXECUTED.clone()
    wrong[0] = -3.0
    found, expected = (
        fit_window(u, 2 * EXECUTED, count).effect(torch.tensor([0.3, 0.4]))
        for u in (wrong, EXECUTED)
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


def test_effects_are_cut_where_they_carry_no_news():
    fits = fit_window(0.01 * EXECUTED, 4 * EXECUTED, ONES)
    assert fits.effect(torch.ones(2)).abs().max() == LIMIT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_batch_in_either_precision(dtype):
    rows = EXECUTED.to(dtype).expand(2, 3, -1, -1)
    fits = fit_window(rows, 2 * rows, ONES.to(dtype).expand(2, 3, -1, -1))
    asked = torch.zeros(2, 3, 7, 2, dtype=dtype)
    for found in (fits.wide().effect(asked), fits.wide().execute(asked, "mixed")):
        assert found.shape == (2, 3, 7, 2 * ANSWERS) and found.dtype is dtype
    single = fit_window(rows[0, 0], 2 * rows[0, 0], ONES.to(dtype))
    torch.testing.assert_close(fits.misses[1, 2], single.misses)
