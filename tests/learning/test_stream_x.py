"""Bounded steps on the latest transition, per mission and member."""

import copy

import pytest
import torch
from harness import transition

from afm_rl.dynamics import Dubins
from afm_rl.learning import GaussianNLLLoss, StreamXUpdater, gaussian_nll, pretrain_ensemble

FORMS = ["error", "loss"]
SETTINGS = {"init": "sparse", "layer_norm": True, "running_count": 1000}


def updater_of(model, **settings):
    return StreamXUpdater(GaussianNLLLoss(model), **settings)


@pytest.fixture
def make(make_ensemble):
    """Make an ensemble of the stream-x kind that has seen a little."""

    def build(**settings):
        model = make_ensemble(**{**SETTINGS, **settings}).double()
        generator = torch.Generator().manual_seed(0)
        inputs = torch.randn(50, 3, generator=generator, dtype=torch.float64)
        inputs = torch.cat([inputs[:, :1].cos(), inputs[:, :1].sin(), inputs[:, 1:]], -1)
        model.normalise_(inputs, 0.1 * inputs[:, :3] + 0.01)
        return model

    return build


def by_hand(model, td, form, kappa=2.0):
    """One step of every member of an unexpanded ensemble, in the plainest way."""
    found = []
    target = model.standardise(
        model.manifold.difference(td["next", "observation"], td["observation"])
    )
    size = target.shape[-1]
    for e in range(model.members):
        mean, log_variance = (x[0, e] for x in model.moments(td["observation"], td["action"]))
        nll = gaussian_nll(mean, log_variance, target[0]).mean()
        error = (target[0] - mean).norm()
        parameters = list(model.parameters())
        if form == "loss":
            steps = [(1.0, torch.autograd.grad(nll, parameters))]
        else:
            slow = torch.autograd.grad(nll, parameters, retain_graph=True)
            head = [torch.zeros_like(g) for g in slow]
            for k in (len(model.weights) - 1, len(parameters) - 1):  # last weight, last bias
                head[k][..., size:] = slow[k][..., size:]
            steps = [(error.item(), torch.autograd.grad(error, parameters)), (1.0, head)]
        values = [parameter.detach()[e].clone() for parameter in parameters]
        for delta, gradients in steps:
            norm = sum(float(g[e].abs().sum()) for g in gradients)
            scale = delta / max(1.0, kappa * max(delta, 1.0) * norm)
            values = [v - scale * g[e] for v, g in zip(values, gradients, strict=True)]
        found.append(values)
    return [torch.stack(parts) for parts in zip(*found, strict=True)]


@pytest.mark.parametrize("form", FORMS)
def test_a_step_is_that_of_each_member_alone(make, transitions, form):
    model = make()
    td = transition(*transitions(1, dtype=torch.float64))
    expected = by_hand(copy.deepcopy(model), td, form)
    loss = GaussianNLLLoss(model)(td)["loss_nll"]
    measured = updater_of(model, form=form)(td)["loss"]
    assert measured.shape == (1,) and not measured.requires_grad
    torch.testing.assert_close(measured[0], loss.detach())
    torch.testing.assert_close([p.data for p in model.parameters()], expected)


@pytest.mark.parametrize("form", FORMS)
def test_a_stream_of_reversed_actions_is_learnt(make, states, box, transitions, form):
    model = make(hidden=[32, 32]).float()
    pretrain_ensemble(model, Dubins(), states, box, samples=2000, epochs=4, lr=1e-2, batch_size=128)
    updater = updater_of(model.expand_(1), form=form)
    state, action = transitions(1, 500, seed=1)
    truth = Dubins()(state, -action)

    @torch.no_grad()
    def miss():
        error = model.manifold.difference(model(state, action), truth)
        return float(error.square().mean().sqrt())

    before = miss()
    stream_state, stream_action = transitions(300, 1, seed=2)
    for s, a in zip(stream_state, stream_action, strict=True):
        updater(transition(s, a))
    assert updater.refused == 0 and miss() < 0.4 * before


def test_a_shared_model_learns_from_all(make, transitions):
    shared = make()
    losses = [updater_of(shared)(transition(*transitions(6, dtype=torch.float64)))["loss"]]
    losses += [updater_of(shared)(transition(*transitions(6, dtype=torch.float64)))["loss"]]
    assert losses[1].mean() < losses[0].mean() and shared.running.count == 62
