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
        return 0.6 * (point - unit[..., -2:]).sign()


@pytest.fixture
def context_under(told):
    """Make the context of four pairs under a map."""

    def make(effect, *batch):
        rows = torch.cat([EXECUTED, effect(EXECUTED), torch.ones(4, 1)], -1)
        return told(rows.flatten().expand(*batch, -1))

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
    found = flow.correct(context_under(effect, *batch), None, torch.zeros(*batch, 2))
    expected = torch.stack([-most, most]) * flow.half_range
    assert found.reach.shape == (*batch, 2, 2)
    torch.testing.assert_close(found.reach, expected.expand(*batch, 2, 2), rtol=0.05, atol=0.05)


def test_the_reach_is_learnt(trained_flow, context_under):
    for gain, least, most in ((2.0, 1.5, 2.5), (0.5, 0.25, 0.8)):
        found = trained_flow.correct(context_under(lambda u, g=gain: g * u), None, torch.zeros(2))
        size = (found.reach / trained_flow.half_range).abs()
        assert (size > least).all() and (size < most).all()


@pytest.mark.parametrize("unsure", [0.1, 1e9])
def test_torn_samples_are_judged_by_their_effects(fitted, context_under, box, unsure):
    flow = fitted(GAINS, unsure=unsure, refine=0.0)
    flow.velocity = Torn()
    planned = torch.tensor([0.3, -0.3]) * flow.half_range
    context = context_under(lambda u: -u)
    found = flow.correct(context, None, planned)
    assert (found.spread / flow.half_range > 0.4).all()
    off = ((found.action + planned) / flow.half_range).norm()  # it takes the opposite
    proposals = planned / flow.half_range + 0.3 * flow.source_points
    proposals = proposals + 0.6 * flow.source_points.sign()
    best = (proposals.clamp(-1, 1) + planned / flow.half_range).norm(dim=-1).min()
    if unsure > 1:
        torch.testing.assert_close(found.action, planned)  # the mean of the two
    else:
        assert off.item() == pytest.approx(best.item(), abs=0.02) and off < 0.5


@pytest.mark.parametrize(
    ("saturation", "wanted"),
    [("direction", [0.2, 0.1]), ("clip", [0.8, 0.4]), ("mixed", [0.2, 0.1])],
)
def test_samples_are_judged_by_what_can_be_had_of_the_plan(
    fitted, context_under, saturation, wanted
):
    flow = fitted(GAINS, saturation=saturation, samples=64, source_std=1.0, unsure=0.0)
    weak, planned = 0.2, torch.tensor([0.8, 0.4])
    flow.velocity.requires_grad_(False)
    for parameter in flow.velocity.parameters():
        parameter.zero_()  # samples stay where they start
    found = flow.correct(context_under(lambda u: weak * u), None, planned * flow.half_range)
    proposals = planned + flow.source_points
    proposals = torch.cat([planned.unsqueeze(0), proposals]).clamp(-1, 1)
    best = (weak * proposals - torch.tensor(wanted)).norm(dim=-1).argmin()
    torch.testing.assert_close(found.action / flow.half_range, proposals[best])


@torch.no_grad()
def test_a_mission_that_is_sure_keeps_its_mean_beside_one_that_is_not(box, told, trained_flow):
    features = torch.stack([torch.zeros(trained_flow.feature_size)] * 2)
    features[1] = torch.randn(trained_flow.feature_size)
    planned = torch.tensor([[0.4, 0.3]]).expand(2, 2)
    trained_flow.unsure = 0.0
    judged = trained_flow.correct(told(features), None, planned)
    trained_flow.unsure = 1e9
    plain = trained_flow.correct(told(features), None, planned)
    width = (plain.spread / trained_flow.half_range).amax(-1).sort().values
    trained_flow.unsure = float(width.mean())
    found = trained_flow.correct(told(features), None, planned).action
    unsure = (plain.spread / trained_flow.half_range).amax(-1) > trained_flow.unsure
    assert unsure.sum() == 1
    assert torch.equal(found, torch.where(unsure.unsqueeze(-1), judged.action, plain.action))


def test_of_wild_proposals_one_in_the_box_is_chosen(box, told):
    flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8)
    for parameter in flow.velocity.parameters():
        parameter.data *= 50.0
    features = torch.randn(20, flow.feature_size)
    found = flow.correct(told(features), None, box[1].expand(20, 2)).action
    assert (found >= box[0]).all() and (found <= box[1]).all()
