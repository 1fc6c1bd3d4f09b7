"""Gain and offset from pairs of unequal worth."""

import torch

from afm_rl.flow.gain_offset import fit_gain_offset, invert_gain_offset, weigh_pairs

GAIN, OFFSET = torch.tensor([-1.0, 0.5, 2.0]), torch.tensor([0.3, 0.0, -0.2])


def pairs(batch=500, count=12):
    generator = torch.Generator().manual_seed(0)
    executed = 2 * torch.rand(batch, count, 3, generator=generator) - 1
    return executed, GAIN * executed + OFFSET, generator


def miss(gain, offset):
    return torch.stack([gain - GAIN, offset - OFFSET]).abs().amax((0, -1)).median()


def test_clean_pairs_give_the_true_gain_and_offset():
    executed, effective, _ = pairs()
    weight = weigh_pairs(torch.full_like(executed, 0.01), torch.ones(12, 1), 1.0)
    assert miss(*fit_gain_offset(executed, effective, weight)) < 0.02


def test_pairs_that_tell_little_count_little():
    executed, effective, generator = pairs()
    blind = torch.rand(executed.shape, generator=generator) < 0.4
    std = torch.where(blind, 2.0, 0.01)
    effective = effective + std * torch.randn(executed.shape, generator=generator)
    ones = torch.ones(12, 1)
    told = fit_gain_offset(executed, effective, weigh_pairs(std, ones, 1.0))
    deaf = fit_gain_offset(executed, effective, weigh_pairs(0 * std, ones, 1.0))
    assert miss(*told) < 0.1 < 0.2 < miss(*deaf)


def test_outliers_do_not_move_the_fit_far():
    executed, effective, generator = pairs()
    effective = effective + 2.0 * (torch.rand(500, 12, 1, generator=generator) < 0.1)
    weight = weigh_pairs(torch.zeros_like(executed), torch.ones(12, 1), 1.0)
    assert miss(*fit_gain_offset(executed, effective, weight)) < 0.1


def test_without_pairs_it_is_the_identity():
    executed, effective, _ = pairs()
    gain, offset = fit_gain_offset(executed, effective, torch.zeros_like(executed))
    torch.testing.assert_close(gain, torch.ones(500, 3))
    torch.testing.assert_close(offset, torch.zeros(500, 3))


def test_the_inverse_undoes_the_fit():
    unit = torch.linspace(-1, 1, 7).unsqueeze(-1).expand(7, 3)
    action = invert_gain_offset(GAIN, OFFSET, unit)
    torch.testing.assert_close(GAIN * action + OFFSET, unit)
