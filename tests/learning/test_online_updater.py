"""Updaters that descend a gradient: on the loss, stream-x, and beside AFM."""

import copy
from functools import partial

import pytest
import torch
from harness import HIGH, transition, weights
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    ResetAdam,
    StreamXUpdater,
    UnmatchedUpdater,
    gaussian_nll,
    pretrain_ensemble,
)
from afm_rl.learning.error_decomposition import decompose_error


def updater_of(model, lr=1e-2, **settings):
    return OnlineUpdater(GaussianNLLLoss(model), lambda p: ResetAdam(p, lr=lr), **settings)


def test_it_is_gradient_descent_on_the_loss_before_the_step(make_ensemble, transitions):
    model = make_ensemble().double()
    reference = copy.deepcopy(model)
    td = transition(*transitions(1, dtype=torch.float64))
    optimizer = torch.optim.Adam(reference.parameters(), lr=1e-2)
    loss = GaussianNLLLoss(reference)(td)["loss_nll"]
    loss.backward()
    optimizer.step()
    measured = updater_of(model)(td)["loss"]
    assert measured.shape == (1,) and not measured.requires_grad
    torch.testing.assert_close(measured[0], loss.detach())
    torch.testing.assert_close(weights(model), weights(reference))


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
def test_masked_missions_do_not_learn_but_are_measured(make_ensemble, transitions, shape):
    missions = make_ensemble().double().expand_(4)
    updater = updater_of(missions)
    updater.mask_key = "learn", "here"
    td = transition(*transitions(4, dtype=torch.float64))
    td["learn", "here"] = torch.tensor([True, False, True, False]).reshape(shape)
    before = [weights(missions, index) for index in range(4)]
    expected = updater.loss(td)["loss_nll"].detach()
    torch.testing.assert_close(updater(td)["loss"], expected)
    changed = [not torch.equal(weights(missions, i), before[i]) for i in range(4)]
    assert changed == [True, False, True, False] and updater.refused == 0


def test_sound_entries_whose_loss_overflows_are_refused(make_ensemble, transitions):
    model = make_ensemble().expand_(2)  # in single precision
    model.target_std.fill_(1e-8)
    updater, before = updater_of(model), [weights(model, index) for index in range(2)]
    td = transition(*transitions(2))
    td["next", "observation"] = model(td["observation"], td["action"]).detach()
    td["next", "observation"][0, 0] = 1e11
    loss = updater(td)["loss"]
    assert loss[0].isnan() and loss[1].isfinite() and updater.refused == 1
    assert torch.equal(weights(model, 0), before[0])
    assert weights(model, 1).isfinite().all() and not torch.equal(weights(model, 1), before[1])


FORMS = ["error", "loss"]
SETTINGS = {"init": "sparse", "layer_norm": True, "running_count": 1000}


def streaming(model, **settings):
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


def step_by_hand(model, td, form, kappa=2.0):
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


def test_traces_belong_to_missions_and_move_only_those_that_learn(make, transitions):
    model = make().expand_(3)
    updater = streaming(model, form="loss", trace=0.9)
    td = transition(*transitions(3, dtype=torch.float64))
    updater(td)
    before = [weights(model, index) for index in range(3)]
    td["next", "observation"][1] = torch.nan
    updater(td)
    changed = [not torch.equal(weights(model, index), before[index]) for index in range(3)]
    assert changed == [True, False, True]
    updater.select_(torch.tensor([2]))
    traces = [state["trace"] for state in updater.optimizer.state.values()]
    assert traces and all(len(trace) == 1 for trace in traces)


def test_traces_of_two_steps_are_refused(make):
    with pytest.raises(ConfigurationError, match=r"updater.trace=0.5: expected 0"):
        streaming(make(), trace=0.5)


@pytest.mark.parametrize("form", FORMS)
def test_a_step_is_that_of_each_member_alone(make, transitions, form):
    model = make()
    td = transition(*transitions(1, dtype=torch.float64))
    expected = step_by_hand(copy.deepcopy(model), td, form)
    loss = GaussianNLLLoss(model)(td)["loss_nll"]
    measured = streaming(model, form=form)(td)["loss"]
    assert measured.shape == (1,) and not measured.requires_grad
    torch.testing.assert_close(measured[0], loss.detach())
    torch.testing.assert_close([p.data for p in model.parameters()], expected)


@pytest.mark.parametrize("form", FORMS)
def test_a_stream_of_reversed_actions_is_learnt(make, states, box, transitions, form):
    model = make(hidden=[32, 32]).float()
    pretrain_ensemble(model, Dubins(), states, box, samples=2000, epochs=4, lr=1e-2, batch_size=128)
    updater = streaming(model.expand_(1), form=form)
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
    shared, td = make(), transition(*transitions(6, dtype=torch.float64))
    losses = [streaming(shared)(td)["loss"] for _ in range(2)]
    assert losses[1].mean() < losses[0].mean() and shared.running.count == 62


GRADIENT = partial(OnlineUpdater, optimizer=partial(ResetAdam, lr=1e-3))


def beside(model, updater=GRADIENT, gate=2.0):  # the small model is a rough one
    model = copy.deepcopy(model).expand_(8)
    return UnmatchedUpdater(GaussianNLLLoss(model), updater, HIGH, gate=gate)


def pushed_rows(gain, push=0.0):
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(8, 3, generator=generator)
    action = (2 * torch.rand(8, 2, generator=generator) - 1) * HIGH
    after = Dubins()(state, action * gain)
    side = torch.stack([-state[:, 2].sin(), state[:, 2].cos(), torch.zeros(8)], -1)
    td = TensorDict({"observation": state, "action": action}, [8])
    return td.set(("next", "observation"), after + push * side)


def rest(updater, td):
    """Return what no action explains, in standard deviations: the mean of missions."""
    rows = td["observation"], td["action"], td["next", "observation"]
    parts = decompose_error(updater.loss.model, *rows, HIGH)
    return parts.unmatched.abs().amax(-1).mean().item()


def weights_of(updater):
    return torch.cat([part.detach().flatten(1) for part in updater.loss.model.parameters()], 1)


def test_what_an_action_can_undo_is_not_learnt(trained_ensemble):
    updater = beside(trained_ensemble)
    before = weights_of(updater)
    losses = [updater(pushed_rows(-1.0))["loss"] for _ in range(5)]
    assert torch.equal(weights_of(updater), before)
    assert bool((losses[0] == losses[-1]).all())
    healthy = beside(trained_ensemble)(pushed_rows(1.0))["loss"]
    assert bool((losses[0] > healthy).all())  # but it is seen


@pytest.mark.parametrize(
    "updater", [GRADIENT, partial(StreamXUpdater, lr=0.1)], ids=["gradient", "stream_x"]
)
def test_what_no_action_can_undo_is_learnt(trained_ensemble, updater):
    learning = beside(trained_ensemble, updater)
    pushed = pushed_rows(-1.0, push=0.3)
    before = rest(learning, pushed)
    for _ in range(30):
        learning(pushed)
    assert rest(learning, pushed) < before / 2


def test_missions_without_such_an_error_stay_as_they_are(trained_ensemble):
    updater = beside(trained_ensemble)
    before = weights_of(updater)
    pushed, plain = pushed_rows(1.0, push=0.3), pushed_rows(1.0)
    half = TensorDict.cat([pushed[:4], plain[4:]])
    updater(half)
    changed = (weights_of(updater) != before).any(1)
    assert changed.tolist() == [True] * 4 + [False] * 4
