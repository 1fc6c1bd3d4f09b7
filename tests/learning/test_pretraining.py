"""Pre-training of an ensemble."""

import copy
import math

import pytest
import torch
from harness import same_weights

from afm_rl.dynamics import Dubins
from afm_rl.learning import fitting, pretrain_ensemble

SHORT = {"samples": 512, "epochs": 2, "batch_size": 64}


@pytest.fixture
def fit(make_ensemble, states, box):
    def run(teacher=None, seed=0, **settings):
        model = make_ensemble()
        report = pretrain_ensemble(
            model, teacher or Dubins(), states, box, seed=seed, **{**SHORT, **settings}
        )
        return model, report.error

    return run


def test_a_small_budget_already_teaches(trained_ensemble, trained_error, transitions):
    assert trained_error < 0.15
    state, action = transitions(1000, seed=5)
    right = Dubins()(state, action)
    error = trained_ensemble.manifold.difference(trained_ensemble(state, action), right)
    change = Dubins().manifold.difference(right, state)
    ratio = error.square().mean(0).sqrt() / change.std(0)
    assert (ratio < 0.2).all()


def test_the_best_epoch_is_kept_and_its_error_returned(fit, monkeypatch):
    errors, seen = iter([0.5, 0.2, 0.9, 0.3]), []  # root mean squares

    def judge(model, *held_out):
        seen.append(copy.deepcopy(model))
        return torch.full((3,), next(errors)).square(), 0.0

    monkeypatch.setattr(fitting, "judge", judge)
    model, best = fit(epochs=4)
    assert best == pytest.approx(0.2)
    assert [same_weights(model, other) for other in seen] == [False, True, False, False]


@pytest.mark.parametrize(("tolerance", "epochs"), [(0.0, 5), (0.1, 3), (0.6, 2)])
def test_it_stops_once_the_held_out_loss_stays(fit, monkeypatch, tolerance, epochs):
    losses = iter([3.0, 2.5, 2.45, 9.0, 9.0])
    seen = []
    monkeypatch.setattr(
        fitting, "judge", lambda *_: (torch.ones(3), seen.append(next(losses)) or seen[-1])
    )
    fit(epochs=5, tolerance=tolerance)
    assert len(seen) == epochs


def test_the_published_step_size_stays(fit, monkeypatch):
    made = []
    plain = torch.optim.Adam

    def adam(*args, **settings):
        made.append(plain(*args, **settings))
        return made[-1]

    monkeypatch.setattr(torch.optim, "Adam", adam)
    for one_cycle in (True, False):
        fit(lr=3e-3, one_cycle=one_cycle)
    assert made[0].param_groups[0]["lr"] < 1e-4 and made[1].param_groups[0]["lr"] == 3e-3


def test_training_that_breaks_down_is_reported_as_such(fit, monkeypatch):
    monkeypatch.setattr(fitting, "judge", lambda *_: (torch.full((3,), math.nan), 0.0))
    assert fit()[1] == math.inf


def test_normalisation_comes_from_the_training_data(fit, states, box):
    model, _ = fit(samples=4096)
    # Headings are uniform: cosine and sine have mean 0 and standard deviation 1 / sqrt(2).
    expected = torch.cat([torch.full((2,), 0.5**0.5), (box[1] - box[0]) / 12**0.5])
    torch.testing.assert_close(model.input_std, expected, rtol=0.05, atol=0)
    torch.testing.assert_close(model.input_mean, torch.zeros(4), rtol=0, atol=0.1)


def test_noise_perturbs_the_action_of_the_teacher_only(fit, box):
    class Spy(Dubins):
        def forward(self, state, action):
            self.seen = action
            return super().forward(state, action)

    plain, noisy = Spy(), Spy()
    models = [fit(plain)[0], fit(noisy, action_noise=0.1)[0]]
    ratio = noisy.seen / plain.seen
    assert ratio.min() >= 0.9 - 1e-6 and ratio.max() <= 1.1 + 1e-6 and ratio.std() > 0.05
    torch.testing.assert_close(models[0].input_std, models[1].input_std)


def test_an_ensemble_can_teach_another(fit, make_ensemble):
    teacher = make_ensemble(seed=4)
    before = {name: value.clone() for name, value in teacher.state_dict().items()}
    _, error = fit(teacher=teacher)
    assert math.isfinite(error)
    assert all(torch.equal(teacher.state_dict()[name], before[name]) for name in before)
    assert all(parameter.grad is None for parameter in teacher.parameters())
