"""Regimes without a robot."""

import pytest
import torch

from afm_rl.correction.achievable import LEAST, LIMIT, MODES
from afm_rl.correction.training import draw_examples
from afm_rl.correction.training.prior import GRID, Draw, Maps, draw_actions, draw_maps, draw_masks

SIZES = [1, 2, 3, 6, 17]


@pytest.fixture
def draw():
    return Draw(torch.Generator().manual_seed(0))


def linear(gains, bias=0.0):
    """Return maps that multiply by gains ``(N, A)``."""
    count, axes = gains.shape
    grid = torch.linspace(-1.0, 1.0, GRID).expand(count, axes, GRID)
    eye = torch.eye(axes).expand(count, axes, axes)
    return Maps(grid, gains.unsqueeze(-1) * eye, bias + torch.zeros(count, axes))


@pytest.mark.parametrize("axes", SIZES)
def test_one_in_twelve_regimes_at_least_is_nominal(axes, draw):
    maps = draw_maps(2000, axes, draw)
    unit = 2 * torch.rand(2000, 3, axes, generator=draw.generator) - 1
    effect = maps.effect(unit)
    assert effect.shape == unit.shape and effect.isfinite().all()
    nominal = ((effect - unit).abs() < 1e-4).flatten(1).all(-1).float().mean()
    assert 0.05 < float(nominal) < 0.4


@pytest.mark.parametrize("axes", SIZES)
@pytest.mark.parametrize("mode", MODES)
def test_the_inverse_has_the_effect_that_was_planned(axes, mode, draw):
    maps = draw_maps(1000, axes, draw)
    sent = 0.99 * (2 * torch.rand(1000, 4, axes, generator=draw.generator) - 1)
    planned = maps.effect(sent)  # so that it can be had
    found = maps.inverse(planned, mode)
    assert found.abs().max() <= 1
    miss = (maps.effect(found) - planned).abs().amax(-1)
    assert (miss < 0.02).float().mean() > 0.97  # steps of quantised maps are missed by a part


@pytest.mark.parametrize("mode", MODES)
def test_plans_that_cannot_be_had_are_saturated_as_robots_do_it(mode):
    generator = torch.Generator().manual_seed(0)
    gains = 0.2 + 1.3 * torch.rand(300, 2, generator=generator)
    gains = gains * torch.where(torch.rand(300, 2, generator=generator) < 0.5, -1.0, 1.0)
    planned = 2 * torch.rand(300, 1, 2, generator=generator) - 1
    limit = gains.abs().unsqueeze(1)
    share = (limit / planned.abs()).amin(-1, keepdim=True).clamp_max(1.0)
    nearest, slower = planned.clamp(-limit, limit), share * planned
    mixed = torch.where(share > LEAST, nearest, slower)
    expected = {"clip": nearest, "direction": slower, "mixed": mixed}[mode]
    effect = gains.unsqueeze(1) * linear(gains).inverse(planned, mode)
    torch.testing.assert_close(effect, expected, rtol=0, atol=1e-4)


def test_what_cannot_be_had_at_all_gives_the_nearest_effect():
    maps = linear(torch.tensor([[1.0, 1.0]]), bias=torch.tensor([0.0, 3.0]))
    for mode in MODES:
        found = maps.inverse(torch.tensor([[[0.5, 0.0]]]), mode)
        assert found.isfinite().all() and found[0, 0, 1] == -1.0


@pytest.mark.parametrize("axes", [1, 2, 17])
@pytest.mark.parametrize("mode", MODES)
def test_examples_have_the_shapes_and_ranges_that_the_flow_reads(axes, mode):
    made = draw_examples(200, axes, 8, 3, mode, torch.Generator().manual_seed(0))
    executed, effective, std, valid = made.rows
    assert executed.shape == effective.shape == std.shape == (200, 8, axes)
    assert valid.shape == (200, 8, 1) and set(valid.unique().tolist()) <= {0.0, 1.0}
    assert executed.abs().max() <= 1 and effective.abs().max() <= LIMIT
    assert (std >= 0).all() and std.max() <= LIMIT
    for part in (executed, effective, std):
        assert not (part * (1 - valid)).any()
    assert made.intended.abs().max() <= 1 and made.probe.abs().max() <= 1
    assert made.planned.abs().max() <= 2 and made.effect.abs().max() <= LIMIT
    for part in made[1:]:
        assert part.shape == (200, 3, axes) and part.isfinite().all()


@pytest.mark.parametrize("rows", [1, 4, 12])
def test_the_oldest_rows_are_missing_and_the_newest_is_of_now(rows, draw):
    fresh, valid = draw_masks(4000, rows, draw)
    for mask in (fresh, valid):
        assert mask.shape == (4000, rows, 1) and (mask[:, -1] == 1).all()
        assert (mask.diff(dim=1) >= 0).all()
    whole = (fresh.sum(1) == rows).float().mean()
    assert float(whole) == pytest.approx(0.5 + 0.5 / rows, abs=0.04)


def test_actions_move_about_everywhere_or_about_one_and_saturate(draw):
    executed = draw_actions(4000, 12, 2, draw)
    assert executed.shape == (4000, 12, 2) and executed.abs().max() <= 1
    stuck = (executed.abs() == 1).float()
    assert 0.02 < float(stuck.mean()) < 0.5
    width = executed.amax(1) - executed.amin(1)
    assert 0.2 < float((width < 0.81).all(-1).float().mean()) < 0.9
