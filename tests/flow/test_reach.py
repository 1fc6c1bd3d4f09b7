"""What the flow makes of its samples, and what it tells of what can be had."""

import pytest
import torch
from torch import nn

from afm_rl.flow import ContextFlow

GAINS, FRICTION = 1, 2  # fits
EXECUTED = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7]])


class Torn(nn.Module):
    """A velocity that carries what starts above the plan up, and what starts below down."""

    def forward(self, inputs):
        unit, point, _ = inputs.split([inputs.shape[-1] - 3, 2, 1], -1)
        own = 0.6 * (point - unit[..., -2:]).sign()
        sure, others = torch.full_like(own, 9.0), torch.zeros_like(own).repeat(1, 5)
        return torch.cat([own, sure, others], -1)  # its own answer, no fit's


class Still(nn.Module):
    """No velocity: samples stay where they start."""

    def forward(self, inputs):
        own = torch.zeros_like(inputs[..., :2])
        return torch.cat([own, torch.full_like(own, 9.0), own.repeat(1, 5)], -1)


@pytest.fixture
def context_under(told):
    """Make the context of four pairs under a map."""

    def make(flow, effect, *batch):
        rows = torch.cat([EXECUTED, effect(EXECUTED), torch.ones(4, 1)], -1)
        return told(flow, rows.flatten().expand(*batch, -1))

    return make


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize(
    ("fit", "effect", "most"),
    [
        (GAINS, lambda u: 2.5 * u, [2.5, 2.5]),
        (GAINS, lambda u: torch.tensor([-0.5, 2.0]) * u, [0.5, 2.0]),
        (FRICTION, lambda u: u - u.clamp(-0.3, 0.3), [0.7, 0.7]),
    ],
    ids=["gain", "gains", "dead zone"],
)
def test_the_reach_is_what_actions_in_the_box_are_worth(
    fitted, context_under, batch, fit, effect, most
):
    flow, most = fitted(fit), torch.tensor(most)
    found = flow.correct(context_under(flow, effect, *batch), None, torch.zeros(*batch, 2))
    expected = torch.stack([-most, most]) * flow.half_range
    assert found.reach.shape == (*batch, 2, 2)
    torch.testing.assert_close(found.reach, expected.expand(*batch, 2, 2), rtol=0.05, atol=0.05)


def test_the_reach_is_learnt(trained_flow, context_under):
    for gain, least, most in ((2.0, 1.5, 2.5), (0.5, 0.25, 0.8)):
        found = trained_flow.correct(
            context_under(trained_flow, lambda u, g=gain: g * u), None, torch.zeros(2)
        )
        size = (found.reach / trained_flow.half_range).abs()
        assert (size > least).all() and (size < most).all()


def test_torn_samples_are_judged_by_their_effects(fitted, context_under):
    flow = fitted(GAINS)
    flow.velocity = Torn()
    planned = torch.tensor([0.3, -0.3]) * flow.half_range
    found = flow.correct(context_under(flow, lambda u: -u), None, planned)
    assert (found.spread / flow.half_range > 0.4).all()
    off = ((found.action + planned) / flow.half_range).norm()  # it takes the opposite
    proposals = planned / flow.half_range + 0.3 * flow.source_points
    proposals = proposals + 0.6 * flow.source_points.sign()
    best = (proposals.clamp(-1, 1) + planned / flow.half_range).norm(dim=-1).min()
    assert off.item() == pytest.approx(best.item(), abs=0.02) and off < 0.5
    torch.testing.assert_close(found.expected, -found.action, rtol=0.01, atol=0.01)


@pytest.mark.parametrize(
    ("saturation", "wanted"),
    [("direction", [0.2, 0.1]), ("clip", [0.8, 0.4]), ("mixed", [0.2, 0.1])],
)
def test_samples_are_judged_by_what_can_be_had_of_the_plan(
    fitted, context_under, saturation, wanted
):
    flow = fitted(GAINS, saturation=saturation, samples=64, source_std=1.0)
    weak, planned = 0.2, torch.tensor([0.8, 0.4])
    flow.velocity = Still()
    found = flow.correct(context_under(flow, lambda u: weak * u), None, planned * flow.half_range)
    proposals = planned + flow.source_points
    proposals = torch.cat([planned.unsqueeze(0), proposals]).clamp(-1, 1)
    best = (weak * proposals - torch.tensor(wanted)).norm(dim=-1).argmin()  # one reach for both
    torch.testing.assert_close(found.action / flow.half_range, proposals[best])


def test_of_wild_proposals_one_in_the_box_is_chosen(box, told):
    flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8)
    for parameter in flow.velocity.parameters():
        parameter.data *= 50.0
    features = torch.randn(20, flow.feature_size)
    found = flow.correct(told(flow, features), None, box[1].expand(20, 2)).action
    assert (found >= box[0]).all() and (found <= box[1]).all()
