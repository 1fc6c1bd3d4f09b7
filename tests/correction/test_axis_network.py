"""One network for any number of axes in any order."""

import pytest
import torch

from afm_rl.correction.achievable import MODES
from afm_rl.correction.experts import EXPERTS, Rows, fit_experts
from afm_rl.correction.network import AxisNetwork


def drawn(*shape, seed=0):
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) - 1


def example(count, axes, rows=6):
    """Return rows of some regimes, plans and points."""
    executed, gain = drawn(count, rows, axes), drawn(count, 1, axes, seed=1)
    valid = (torch.arange(rows) >= torch.arange(count).view(-1, 1) % rows).float().unsqueeze(-1)
    std = 0.05 * drawn(count, rows, axes, seed=2).abs()
    rows = Rows(executed, gain * executed + 0.1, std, torch.ones_like(std[..., :1]) * valid)
    return rows, drawn(count, 1, axes, seed=3), drawn(count, 4, axes, seed=4)


@pytest.fixture(scope="module")
def network():
    return AxisNetwork(width=24, latent=12)


def answers(network, rows, plans, points, mode="mixed", tau=0.3):
    encoded = network.encode(rows, fit_experts(rows))
    velocity = network.velocity(network.ask(encoded, plans, mode), tau, points)
    return velocity, network.effect(encoded, points)


@pytest.mark.parametrize("axes", [1, 2, 3, 5, 6, 9, 17])
@pytest.mark.parametrize("mode", MODES)
def test_any_number_of_axes(network, axes, mode):
    rows, plans, points = example(3, axes)
    for found in answers(network, rows, plans, points, mode):
        assert found.shape == (3, 4, axes) and found.isfinite().all()


@pytest.mark.parametrize("axes", [2, 3, 6, 17])
def test_axes_may_come_in_any_order(network, axes):
    given = example(3, axes)
    order = torch.randperm(axes, generator=torch.Generator().manual_seed(axes))
    rows = Rows(*(part[..., order] for part in given[0][:3]), given[0].valid)
    moved = answers(network, rows, *(part[..., order] for part in given[1:]))
    for found, expected in zip(moved, answers(network, *given), strict=True):
        torch.testing.assert_close(found, expected[..., order], rtol=1e-4, atol=1e-4)


def test_an_axis_hears_of_the_others_unless_it_is_cut_off():
    rows, plans, points = example(2, 3)
    other = rows._replace(std=rows.std * torch.tensor([1.0, 1.0, 30.0]))
    for across in (True, False):
        network = AxisNetwork(width=24, latent=12, across=across)
        found, changed = (answers(network, r, plans, points)[1] for r in (rows, other))
        heard = not torch.allclose(found[..., 0], changed[..., 0], atol=1e-6)
        # The affine fit, an expert, reads all axes either way; its weights are per axis.
        assert heard == across


def test_lesions_hide_what_they_say():
    rows, plans, points = example(2, 2)
    loud = rows._replace(std=torch.where(rows.valid == 1.0, 1e-4 + 0 * rows.std, 0.0))
    calm = rows._replace(std=torch.where(rows.valid == 1.0, 1e-3 + 0 * rows.std, 0.0))
    for noise in (True, False):
        network = AxisNetwork(width=24, latent=12, noise=noise)
        one, two = (answers(network, r, plans, points)[1] for r in (loud, calm))
        assert torch.allclose(one, two, atol=2e-4) != noise
    alone = AxisNetwork(width=24, latent=12, experts=False)
    encoded = alone.encode(rows, fit_experts(rows))
    asked = alone.ask(encoded, plans, "clip")
    shifted = asked._replace(answers=asked.answers + 1.0)
    found = alone.velocity(asked, 0.5, points)
    assert torch.equal(found, alone.velocity(shifted, 0.5, points))


def test_axes_may_read_different_sets_of_rows(network):
    rows, _, points = example(6, 2)  # three sets for each of two missions
    encoded = network.encode(rows, fit_experts(rows))
    which = torch.tensor([[2, 0], [1, 1]])  # by axis
    points = points[:2]
    found = network.effect(encoded.choose(which), points)
    for mission, axis in ((0, 0), (0, 1), (1, 0), (1, 1)):
        whole = encoded.choose(which[:, axis : axis + 1].expand(2, 2))
        expected = network.effect(whole, points)
        torch.testing.assert_close(
            found[mission, :, axis], expected[mission, :, axis], rtol=1e-3, atol=1e-3
        )


def test_without_any_row_the_answers_are_finite(network):
    rows = Rows(*(torch.zeros(2, 6, 3) for _ in range(3)), torch.zeros(2, 6, 1))
    _, plans, points = example(2, 3)
    assert all(found.isfinite().all() for found in answers(network, rows, plans, points))


def test_an_answer_of_full_share_is_that_expert(network):
    rows, plans, points = example(3, 2)
    twin = AxisNetwork(width=24, latent=12)
    encoded = twin.encode(rows, fit_experts(rows))
    asked = twin.ask(encoded, plans, "mixed")
    for k in range(EXPERTS):
        for head in (twin.plan_head, twin.effect_head):
            torch.nn.init.zeros_(head[-1].weight)
            torch.nn.init.zeros_(head[-1].bias)
            head[-1].bias.data[2 + k] = 9.0  # its own answer, that one's logit, the experts'
        effect = encoded.experts.effect(points)[..., k].mT
        torch.testing.assert_close(twin.effect(encoded, points), effect, rtol=1e-4, atol=1e-4)
        start = plans + points
        velocity = twin.velocity(asked, 0.0, start)  # straight to the expert's action
        torch.testing.assert_close(start + velocity, asked.answers[..., k].mT.expand_as(start))


def test_times_may_be_one_number_or_many(network):
    rows, plans, points = example(3, 2)
    asked = network.ask(network.encode(rows, fit_experts(rows)), plans, "clip")
    found = network.velocity(asked, torch.full((3, 4, 1), 0.7), points)
    torch.testing.assert_close(found, network.velocity(asked, 0.7, points))
