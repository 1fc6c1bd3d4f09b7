"""What least squares tells a flow."""

import pytest
import torch

from afm_rl.flow.hints import FITS, least_squares_hints
from afm_rl.flow.least_squares import fit_friction, invert_friction

AXIS = torch.linspace(-1, 1, 5)
PLANS = torch.cartesian_prod(AXIS, AXIS)
EXECUTED = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7], [0.4, 0.9], [0.6, -1]])


def hints_of(effective, plans=PLANS, executed=EXECUTED, saturation="direction", valid=1.0):
    """Return actions and logarithms of misses, ``(25, FITS, 2)`` each."""
    count = torch.full((*executed.shape[:-1], 1), valid)
    rows = [part.expand(len(plans), *part.shape) for part in (executed, effective, count)]
    found = least_squares_hints(*rows, plans, saturation)
    actions, misses = found.unflatten(-1, (2 * FITS, 2)).split(FITS, -2)
    return actions, misses


@pytest.mark.parametrize("saturation", ["direction", "clip"])
def test_all_fits_are_exact_for_gains(saturation):
    gain = torch.tensor([-1.6, 1.3])
    actions, misses = hints_of(gain * EXECUTED, saturation=saturation)
    for action in actions.unbind(-2):
        torch.testing.assert_close(action, PLANS / gain, rtol=0, atol=0.02)
        assert action.abs().max() <= 1
    assert (misses < -4).all()


def test_each_explains_what_it_can_express():
    rubbing = EXECUTED - 0.3 * EXECUTED.sign()
    turned = EXECUTED @ torch.tensor([[0.6, 0.8], [-0.8, 0.6]]) + 0.1
    best = [hints_of(seen)[1].mean((0, -1)).argmin().item() for seen in (rubbing, turned)]
    assert best == [2, 3]  # friction, affine


def test_friction_is_overcome():
    gain, offset = torch.tensor([-0.8, 1.2]), torch.tensor([0.2, -0.3])
    effective = gain * EXECUTED + offset * EXECUTED.sign()
    fitted = fit_friction(EXECUTED, effective, torch.ones(6, 1), 0.9)
    torch.testing.assert_close(fitted[0], gain, rtol=0, atol=0.05)
    torch.testing.assert_close(fitted[1], offset, rtol=0, atol=0.05)
    wanted = torch.tensor([0.5, -0.4])
    action = invert_friction(gain, offset, wanted)
    torch.testing.assert_close(gain * action + offset * action.sign(), wanted)


def test_knowing_nothing_the_plan_is_believed():
    actions, _ = hints_of(torch.zeros_like(EXECUTED), valid=0.0)
    torch.testing.assert_close(actions, PLANS.unsqueeze(-2).expand(-1, FITS, -1), rtol=0, atol=1e-3)
