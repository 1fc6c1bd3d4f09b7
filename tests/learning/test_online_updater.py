"""One gradient step per transition and mission."""

import copy

import pytest
import torch
from harness import transition, weights

from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam


def updater_of(model, lr=1e-2, **settings):
    return OnlineUpdater(GaussianNLLLoss(model), lambda p: ResetAdam(p, lr=lr), **settings)


@pytest.fixture
def missions(make_ensemble):
    return make_ensemble().double().expand_(4)


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
def test_masked_missions_do_not_learn_but_are_measured(missions, transitions, shape):
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


def test_it_learns_where_gradients_are_switched_off(make_ensemble, transitions):
    model = make_ensemble()
    updater, before = updater_of(model), weights(model)
    with torch.no_grad():
        updater(transition(*transitions(2)))
    assert updater.learns and not torch.equal(weights(model), before)
