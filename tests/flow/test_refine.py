"""An answer that is not in doubt comes nearer to its effect."""

import pytest
import torch
from torch import nn

from afm_rl.flow.proposals import APART, beside, newton_step

GAINS = 1  # a fit
MATRIX = torch.tensor([[-0.8, 0.3], [0.2, 1.5]])
BIAS = torch.tensor([0.1, -0.2])


def worth(action):
    return action @ MATRIX.T + BIAS


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_an_affine_effect_is_reached_in_one_step(batch):
    generator = torch.Generator().manual_seed(0)
    action, wanted = (0.3 * torch.randn(*batch, 2, generator=generator) for _ in range(2))
    found = newton_step(action, worth(action), worth(beside(action)), wanted, 10.0)
    inside = found.abs().amax(-1) < 1
    assert inside.any()
    left = (worth(found) - wanted).abs().amax(-1)
    assert (left[inside] < 0.01).all()


def test_it_keeps_to_its_longest_step_and_to_the_box():
    action, wanted = torch.zeros(2), worth(torch.tensor([0.5, -0.9]))
    near = newton_step(action, worth(action), worth(beside(action)), wanted, 0.2)
    torch.testing.assert_close(near, torch.tensor([0.2, -0.2]))
    far = worth(torch.tensor([3.0, -3.0]))
    found = newton_step(action, worth(action), worth(beside(action)), far, 10.0)
    torch.testing.assert_close(found, torch.tensor([1.0, -1.0]))


def test_where_no_action_does_anything_it_stays():
    action = torch.tensor([0.4, -0.1])
    found = newton_step(action, torch.zeros(2), torch.zeros(4, 2), torch.ones(2), 0.2)
    torch.testing.assert_close(found, action)


def test_neighbours_lie_to_either_side_of_each_axis():
    around = beside(torch.zeros(5, 3))
    assert around.shape == (5, 6, 3)
    torch.testing.assert_close(around[0, :3], APART * torch.eye(3))
    torch.testing.assert_close(around[0, 3:], -APART * torch.eye(3))


class Drift(nn.Module):
    """A velocity that carries everything to the inverse of a gain of -1, and a bit beyond."""

    def forward(self, inputs):
        unit, point, tau = inputs[..., -5:-3], inputs[..., -3:-1], inputs[..., -1:]
        return (0.1 - unit - point) / (1 - tau)


@pytest.mark.parametrize("unsure", [0.1, 0.0])
def test_the_flow_refines_what_is_not_in_doubt(fitted, told, unsure):
    executed = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7]])
    features = torch.cat([executed, -executed, torch.ones(4, 1)], -1).flatten()
    planned = torch.tensor([0.3, -0.3])
    missed = []
    for step in (0.0, 0.2):
        flow = fitted(GAINS, refine=step, unsure=unsure, steps=12)
        flow.velocity = Drift()
        found = flow.correct(told(features), None, planned * flow.half_range)
        missed.append((found.action / flow.half_range + planned).abs().max().item())
    assert missed[0] > 0.05
    if unsure:
        assert missed[1] < 0.01  # effects say how far it is off
    else:
        assert missed[1] == missed[0]  # samples that differ are chosen from
