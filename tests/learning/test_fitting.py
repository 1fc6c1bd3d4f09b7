"""Fitting an ensemble to transitions that were observed."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import Dubins, Ensemble
from afm_rl.errors import ConfigurationError, NonFiniteError
from afm_rl.learning import fit_ensemble
from afm_rl.manifold import Manifold

SHORT = {"epochs": 2, "batch_size": 64}


@pytest.fixture
def observed(transitions):
    """Transitions of the nominal ground robot, ``(20, 50)``."""
    state, action = transitions(20, 50)
    data = TensorDict({"observation": state, "action": action}, [20, 50])
    return data.set(("next", "observation"), Dubins()(state, action))


def same(left, right):
    right = right.state_dict()
    return all(torch.equal(value, right[name]) for name, value in left.state_dict().items())


def test_it_learns_what_was_observed(make_ensemble, observed, transitions):
    model = make_ensemble(hidden=[32, 32])
    error = fit_ensemble(model, observed, epochs=60, lr=1e-2, batch_size=100)
    assert error < 0.3
    state, action = transitions(200, seed=9)
    truth = Dubins()(state, action)
    miss = model.manifold.difference(model(state, action), truth).square().mean().sqrt()
    change = Dubins().manifold.difference(truth, state).square().mean().sqrt()
    assert miss < 0.4 * change


def test_the_seed_decides_everything_and_the_global_generator_nothing(make_ensemble, observed):
    models = []
    before = torch.get_rng_state()
    for seed in (1, 1, 2):
        models.append(make_ensemble())
        fit_ensemble(models[-1], observed, seed=seed, **SHORT)
    assert torch.equal(torch.get_rng_state(), before)
    assert same(models[0], models[1]) and not same(models[0], models[2])


def test_fewer_transitions_than_a_batch_are_one_batch(make_ensemble, observed):
    model = make_ensemble()
    fit_ensemble(model, observed[:1, :10], epochs=1, batch_size=64)
    assert not same(model, make_ensemble())


def test_a_coordinate_that_never_changes_causes_no_surprise():
    entries = {"observation": torch.randn(500, 2), "action": torch.randn(500, 1)}
    data = TensorDict(entries, [500])
    step = torch.cat([0.1 * data["action"], torch.zeros(500, 1)], -1)
    data["next", "observation"] = data["observation"] + step
    model = Ensemble(Manifold(2), 1, features=[0, 1], members=2, hidden=[16])
    fit_ensemble(model, data, epochs=30, lr=1e-2)
    expected, noise = model.forecast(data["observation"], data["action"])
    surprise = (data["next", "observation"] - expected).abs() / noise
    assert surprise[:, 1].max() < 10 and noise[:, 1].min() > 1e-4


def test_keys_may_be_others(make_ensemble, observed):
    named = TensorDict(
        {
            "pose": observed["observation"],
            "agent": {"force": observed["action"], "later": observed["next", "observation"]},
        },
        observed.batch_size,
    )
    models = make_ensemble(), make_ensemble()
    fit_ensemble(models[0], observed, **SHORT)
    keys = ("pose", ["agent", "force"], ["agent", "later"])
    fit_ensemble(models[1], named, keys=keys, **SHORT)
    assert same(*models)


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_numbers_that_are_not_finite_are_refused(make_ensemble, observed, key):
    observed[key][3, 4, 0] = torch.nan
    with pytest.raises(NonFiniteError, match="transitions: .*not finite"):
        fit_ensemble(make_ensemble(), observed)


@pytest.mark.parametrize(
    "settings",
    [{"epochs": 0}, {"batch_size": 0}, {"lr": 0.0}, {"held_out": 0.0}, {"held_out": 0.6}],
    ids=str,
)
def test_impossible_settings_are_refused(make_ensemble, observed, settings):
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        fit_ensemble(make_ensemble(), observed, **settings)


def test_one_transition_is_too_few(make_ensemble, observed):
    with pytest.raises(ConfigurationError, match="transitions=1"):
        fit_ensemble(make_ensemble(), observed[:1, :1])
