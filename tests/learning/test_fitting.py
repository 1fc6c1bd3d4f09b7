"""Ensembles are fitted to transitions, and to other models."""

import copy
import math
from functools import partial

import pytest
import torch
from harness import same_weights
from tensordict import TensorDict

from afm_rl.dynamics import Calibrated, Dubins, Ensemble
from afm_rl.errors import NonFiniteError
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    ResetAdam,
    RLSUpdater,
    StreamXUpdater,
    UnmatchedUpdater,
    fit_ensemble,
    fitting,
    pretrain_ensemble,
)
from afm_rl.planning import ICEM, MPPI, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold, RigidBodySpace

SHORT = {"epochs": 2, "batch_size": 64}


@pytest.fixture
def observed(transitions):
    """Transitions of the nominal ground robot, ``(20, 50)``."""
    state, action = transitions(20, 50)
    data = TensorDict({"observation": state, "action": action}, [20, 50])
    return data.set(("next", "observation"), Dubins()(state, action))


@pytest.mark.filterwarnings("ignore:the model leaves")
def test_rows_that_are_hard_to_predict_are_not_given_up():
    draw = torch.Generator().manual_seed(0)
    state = 2 * torch.rand(2000, 1, generator=draw) - 1
    rough = torch.where(state > 0, (10 * state).sin(), 0.1 * state)  # half of it is easy
    data = TensorDict({"observation": state, "action": state}, [2000])
    data = data.set(("next", "observation"), state + rough)
    ensemble = partial(Ensemble, Manifold(1), 1, features=[0], members=2, hidden=[32, 32])
    errors = [fit_ensemble(ensemble(), data, epochs=40, beta=beta).error for beta in (0.0, 1.0)]
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize("heading", ["wrapped", "unwrapped"])
def test_headings_are_read_as_cosine_and_sine(heading):
    draw = torch.Generator().manual_seed(0)
    state = 40 * (torch.rand(4000, 3, generator=draw, dtype=torch.float64) - 0.5)  # m, m, rad
    action = 2 * torch.rand(4000, 2, generator=draw, dtype=torch.float64) - 1
    after = Dubins().double()(state, action)
    if heading == "wrapped":
        state[:, 2] = torch.remainder(state[:, 2] + torch.pi, 2 * torch.pi) - torch.pi
    boat = TensorDict({"observation": state, "action": action}, [4000])
    boat = boat.set(("next", "observation"), after)
    settings = {"epochs": 12, "lr": 1e-2}

    def fitted(**more):
        torch.manual_seed(0)
        model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], members=2, hidden=[32], **more)
        return fit_ensemble(model, boat, names=["x", "y", "theta"], **settings)

    report = fitted()
    assert max(report.unexplained) < 0.1
    assert max(report.rms[:2]) < 0.03  # m; the boat moves by up to 0.2 m
    if heading == "unwrapped":
        told = r"third of the variance of x \(\d+ %, error 0\.\d+\), y"
        with pytest.warns(UserWarning, match=told):
            report = fitted(encode=False)
        assert min(report.unexplained[:2]) > 0.33


def test_rotations_are_read_without_their_sign():
    space, draw = RigidBodySpace(), torch.Generator().manual_seed(0)
    state = space.project(torch.randn(50, 13, generator=draw))
    same = torch.cat([state[:, :6], -state[:, 6:10], state[:, 10:]], -1)
    read = space.encode(state)
    assert read.shape == (50, 18)
    torch.testing.assert_close(space.encode(same), read)
    axes = read[:, 9:].unflatten(-1, (3, 3))
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5, rtol=0)
    assert torch.equal(space.encode(state, [3, 12]), state[:, [3, 12]])
    assert space.encode(state, [3, 6, 7, 8, 9]).shape == (50, 10)


def test_double_observations_and_single_actions(trained_ensemble, transitions):
    state, action = transitions(3, 40)
    after = Dubins()(state, action)
    model = trained_ensemble
    ahead, noise = model.forecast(state.double(), action)
    assert ahead.dtype is noise.dtype is model.jacobian(state.double(), action).dtype
    assert ahead.dtype is torch.float64
    torch.testing.assert_close(ahead.float(), model(state, action))
    mixed = TensorDict({"observation": state.double(), "action": action}, [3, 40])
    mixed = mixed.set(("next", "observation"), after.double())
    fit_ensemble(model, mixed, **SHORT)
    assert {p.dtype for p in model.parameters()} == {torch.float32}
    learner = partial(OnlineUpdater, optimizer=ResetAdam)
    for updater in (
        OnlineUpdater(GaussianNLLLoss(model), ResetAdam),
        StreamXUpdater(GaussianNLLLoss(model)),
        UnmatchedUpdater(GaussianNLLLoss(model), learner, [1, 1]),
        RLSUpdater(GaussianNLLLoss(Calibrated(model, torch.ones(2)))),
    ):
        assert updater(mixed)["loss"].isfinite().all()
    cost = KnownReward(lambda state, action, after: -after[..., 0])
    world = PlanningEnv(model, cost, -torch.ones(2), torch.ones(2))
    for kind in (MPPI, ICEM):
        planner = kind(world, horizon=3, candidates=20)
        start = planner.make_tensordict_primer().primers.zero((3,))
        start.set("observation", mixed["observation"][:, 0])
        assert planner(start)["action"].shape == (3, 2)


@pytest.mark.filterwarnings("ignore:the model leaves")
@pytest.mark.parametrize(("count", "passes"), [(10, 1), (500, 8)])
def test_few_transitions_are_several_batches_all_the_same(
    make_ensemble, observed, monkeypatch, count, passes
):
    steps = []
    monkeypatch.setattr(torch.optim.Adam, "step", lambda *_: steps.append(1))
    fit_ensemble(make_ensemble(), observed.reshape(-1)[:count], epochs=1, batch_size=256)
    assert len(steps) == passes


def pushed(start):
    """Fit a model to one coordinate that is pushed, and another that never changes."""
    data = TensorDict({"observation": start, "action": torch.randn(500, 1)}, [500])
    step = torch.cat([0.1 * data["action"], torch.zeros(500, 1)], -1)
    data["next", "observation"] = start + step
    model = Ensemble(Manifold(2), 1, features=[0, 1], members=2, hidden=[16])
    fit_ensemble(model, data, epochs=30, lr=1e-2)
    return model, data


def test_a_coordinate_that_never_changes_causes_no_surprise():
    model, data = pushed(torch.randn(500, 2))
    expected, noise = model.forecast(data["observation"], data["action"])
    surprise = (data["next", "observation"] - expected).abs() / noise
    assert surprise[:, 1].max() < 10 and noise[:, 1].min() > 1e-4


def test_a_coordinate_that_is_always_the_same_stays_so_in_long_plans():
    """It did explode: what the network added to it was divided by a rounding error."""
    start = torch.randn(500, 2) * torch.tensor([1.0, 0.0]) + torch.tensor([0.0, 0.3])
    model, data = pushed(start)
    plans = torch.randn(20, 50, 1)
    states = model.rollout(torch.tensor([0.5, 0.3]), plans)
    torch.testing.assert_close(states[..., 1], torch.full((20, 50), 0.3))
    torch.testing.assert_close(
        states[..., 0], 0.5 + 0.1 * plans[..., 0].cumsum(-1), atol=0.2, rtol=0.0
    )
    assert (model.jacobian(start, data["action"])[:, 1] == 0).all()


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
    assert same_weights(*models)


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_numbers_that_are_not_finite_are_refused(make_ensemble, observed, key):
    observed[key][3, 4, 0] = torch.nan
    with pytest.raises(NonFiniteError, match="transitions: .*not finite"):
        fit_ensemble(make_ensemble(), observed)


BRIEF = {"samples": 512, "epochs": 2, "batch_size": 64}


@pytest.fixture
def pretrain(make_ensemble, states, box):
    def run(teacher=None, seed=0, **settings):
        model = make_ensemble()
        report = pretrain_ensemble(
            model, teacher or Dubins(), states, box, seed=seed, **{**BRIEF, **settings}
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


def test_the_best_epoch_is_kept_and_its_error_returned(pretrain, monkeypatch):
    errors, seen = iter([0.5, 0.2, 0.9, 0.3]), []  # root mean squares

    def judge(model, *held_out):
        seen.append(copy.deepcopy(model))
        return torch.full((3,), next(errors)).square(), 0.0

    monkeypatch.setattr(fitting, "judge", judge)
    model, best = pretrain(epochs=4)
    assert best == pytest.approx(0.2)
    assert [same_weights(model, other) for other in seen] == [False, True, False, False]


@pytest.mark.parametrize(("tolerance", "epochs"), [(0.0, 5), (0.1, 3), (0.6, 2)])
def test_it_stops_once_the_held_out_loss_stays(pretrain, monkeypatch, tolerance, epochs):
    losses = iter([3.0, 2.5, 2.45, 9.0, 9.0])
    seen = []
    monkeypatch.setattr(
        fitting, "judge", lambda *_: (torch.ones(3), seen.append(next(losses)) or seen[-1])
    )
    pretrain(epochs=5, tolerance=tolerance)
    assert len(seen) == epochs


def test_the_published_step_size_stays(pretrain, monkeypatch):
    made = []
    plain = torch.optim.Adam

    def adam(*args, **settings):
        made.append(plain(*args, **settings))
        return made[-1]

    monkeypatch.setattr(torch.optim, "Adam", adam)
    for one_cycle in (True, False):
        pretrain(lr=3e-3, one_cycle=one_cycle)
    assert made[0].param_groups[0]["lr"] < 1e-4 and made[1].param_groups[0]["lr"] == 3e-3


def test_training_that_breaks_down_is_reported_as_such(pretrain, monkeypatch):
    monkeypatch.setattr(fitting, "judge", lambda *_: (torch.full((3,), math.nan), 0.0))
    assert pretrain()[1] == math.inf


def test_noise_perturbs_the_action_of_the_teacher_only(pretrain, box):
    class Spy(Dubins):
        def forward(self, state, action):
            self.seen = action
            return super().forward(state, action)

    plain, noisy = Spy(), Spy()
    models = [pretrain(plain)[0], pretrain(noisy, action_noise=0.1)[0]]
    ratio = noisy.seen / plain.seen
    assert ratio.min() >= 0.9 - 1e-6 and ratio.max() <= 1.1 + 1e-6 and ratio.std() > 0.05
    torch.testing.assert_close(models[0].input_std, models[1].input_std)
