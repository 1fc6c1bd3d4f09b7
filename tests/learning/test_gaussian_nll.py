"""The loss of a dynamics model."""

import math

import pytest
import torch
from harness import loss_by_row, transition
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.learning import GaussianNLLLoss, gaussian_nll


@pytest.fixture
def data(make_ensemble, transitions):
    """An ensemble in double precision and transitions that it does not explain."""
    model = make_ensemble().double()
    state, action = transitions(6, dtype=torch.float64)
    seen = Dubins()(state, action) + 0.1 * torch.randn(6, 3, dtype=torch.float64)
    return model, transition(state, action, seen)


def test_it_is_twice_the_negative_log_likelihood_without_its_constant():
    mean, target = torch.randn(2, 50, dtype=torch.float64)
    log_variance = torch.linspace(-5, 2, 50, dtype=torch.float64)
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = -2 * normal.log_prob(target) - math.log(2 * math.pi)
    torch.testing.assert_close(gaussian_nll(mean, log_variance, target), expected)


def test_beta_takes_the_variance_out_of_the_means_weight():
    mean, target = torch.randn(2, 50, dtype=torch.float64)
    mean.requires_grad_()
    log_variance = torch.linspace(-5, 2, 50, dtype=torch.float64, requires_grad=True)
    for beta, weight in ((1.0, torch.ones(50)), (0.5, (-0.5 * log_variance).exp())):
        loss = gaussian_nll(mean, log_variance, target, beta).sum()
        of_mean, of_variance = torch.autograd.grad(loss, (mean, log_variance))
        torch.testing.assert_close(of_mean, (2 * weight * (mean - target)).detach())
        scaled = (mean - target).square() * (-log_variance).exp()
        torch.testing.assert_close(
            of_variance, ((beta * log_variance).exp() * (1 - scaled)).detach()
        )


def test_it_is_averaged_over_members_coordinates_and_the_batch(data):
    model, td = data
    change = model.manifold.difference(td["next", "observation"], td["observation"])
    mean, log_variance = model.moments(td["observation"], td["action"])
    normal = torch.distributions.Normal(
        mean * model.target_std + model.target_mean, (0.5 * log_variance).exp() * model.target_std
    )
    expected = -2 * normal.log_prob(change.unsqueeze(-2)) - math.log(2 * math.pi)
    expected = expected - 2 * model.target_std.log()  # the loss is in standardised units
    each = loss_by_row(model)(td)["loss_nll"]
    torch.testing.assert_close(each, expected.mean((-2, -1)))
    result = GaussianNLLLoss(model)(td)
    assert result.batch_size == ()
    torch.testing.assert_close(result["loss_nll"], each.mean())


def test_keys_can_be_chosen(data):
    model, td = data
    loss = GaussianNLLLoss(model)
    assert loss.in_keys == ["observation", "action", ("next", "observation")]
    expected = loss(td)["loss_nll"]
    moved = TensorDict({}, [6])
    moved["robot", "pose"], moved["did"] = td["observation"], td["action"]
    moved["then"] = td["next", "observation"]
    loss.set_keys(state=("robot", "pose"), action="did", next_state="then")
    assert loss.in_keys == [("robot", "pose"), "did", "then"]
    torch.testing.assert_close(loss(moved)["loss_nll"], expected)
    loss.in_keys = ["did", "then"]
    assert loss.in_keys == ["did", "then"]


def test_masked_transitions_do_not_count(data):
    model, td = data
    td = td.clone()
    td["next", "observation"][4:] = math.nan
    td["mask"] = torch.arange(6) < 4
    loss = GaussianNLLLoss(model)
    loss.loss_mask_key = "mask"
    torch.testing.assert_close(loss(td)["loss_nll"], loss(td[:4])["loss_nll"])


@pytest.mark.parametrize(("wrap", "turn"), [(True, 0.2), (False, 0.2 - 2 * math.pi)])
def test_a_turn_across_pi_is_small_unless_angles_are_subtracted(wrap, turn):
    state = torch.tensor([0.0, 0.0, math.pi - 0.1])
    after = torch.tensor([0.0, 0.0, 0.1 - math.pi])
    target = GaussianNLLLoss(Dubins(noise_std=1.0), wrap=wrap).target(state, after)
    assert target[2].item() == pytest.approx(turn, abs=1e-5)
