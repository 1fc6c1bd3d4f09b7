"""What was seen corrects what is foreseen."""

import pytest
import torch

from afm_rl.errors import ConfigurationError
from afm_rl.flow import ContextFlow
from afm_rl.flow.kriging import krige

BOX = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
GENERATOR = torch.Generator().manual_seed(0)


def draw(*shape):
    return 2 * torch.rand(*shape, generator=GENERATOR) - 1


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_what_was_tried_is_known_and_what_is_far_is_not(batch):
    tried, missed = draw(*batch, 6, 2), draw(*batch, 6, 2)
    tried[..., 0] = torch.linspace(-1.0, 1.0, 6)  # well apart
    valid = torch.ones(*batch, 6, 1)
    torch.testing.assert_close(krige(tried, tried, missed, valid, 0.1), missed, atol=0.05, rtol=0)
    assert krige(tried + 5.0, tried, missed, valid, 0.1).abs().max() < 1e-6


def test_rows_that_do_not_count_change_nothing():
    asked, tried, missed = draw(4, 5, 2), draw(4, 6, 2), draw(4, 6, 2)
    valid = (torch.arange(6) < 4).float().unsqueeze(-1).expand(4, 6, 1)
    found = krige(asked, tried, missed, valid, 0.3)
    fewer = krige(asked, tried[:, :4], missed[:, :4], valid[:, :4], 0.3)
    torch.testing.assert_close(found, fewer)


def test_small_actions_are_told_apart_as_well_as_large_ones():
    asked, tried, missed = draw(5, 2), draw(6, 2), draw(6, 2)
    valid = torch.ones(6, 1)
    found = krige(asked, tried, missed, valid, 0.3)
    torch.testing.assert_close(krige(0.02 * asked, 0.02 * tried, missed, valid, 0.3), found)
    none = torch.zeros(6, 2)
    assert krige(none, none, missed, valid, 0.3).isfinite().all()


def test_repeats_are_averaged():
    tried, valid = torch.zeros(50, 1), torch.ones(50, 1)
    missed = 1.0 + 0.3 * torch.randn(50, 1, generator=GENERATOR)
    found = krige(torch.zeros(1, 1), tried, missed, valid, 0.2)
    assert abs(found.item() - 1.0) < 0.15


def context_of(flow, executed, effective):
    rows = torch.cat([executed, effective, torch.ones(len(executed), 1)], -1)
    return rows.flatten()


def test_a_flow_expects_again_what_it_has_seen():
    flow = ContextFlow(*BOX, window=4, memory=20, hidden=[8], latent=4)
    still = ContextFlow(*BOX, window=4, memory=20, hidden=[8], latent=4, length_scale=0.0)
    executed, effective = (
        torch.tensor([[-1.0, 0.0], [-0.3, 0.2], [0.5, 0.5], [1.0, -1.0]]),
        draw(4, 2),
    )
    features = context_of(flow, executed, effective)
    with torch.no_grad():
        known = flow.read(features)
        seen = flow.foresee(features, known, executed)
        guess = still.foresee(features, known, executed)
        torch.testing.assert_close(guess, flow.effect(known.wide(), executed))
    assert (seen - effective).abs().max() < 0.05 < (guess - effective).abs().max()


def test_a_negative_length_scale_is_refused():
    with pytest.raises(ConfigurationError, match="flow.length_scale=-1"):
        ContextFlow(*BOX, length_scale=-1.0)
