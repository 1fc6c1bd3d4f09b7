"""Learning networks from windows of a flight."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from afm_rl.dynamics import KNODE, Quadrotor
from afm_rl.dynamics.quadrotor import quadrotor_path
from afm_rl.dynamics.residual import Network
from afm_rl.learning import GaussianNLLLoss, KNODEUpdater, knode_fit
from afm_rl.learning.knode_fit import first_order, fit_network
from afm_rl.missions.state import Loop, StepLog, restore, snapshot
from afm_rl.spaces.airframe import QuadrotorBody
from afm_rl.storage.artefacts import Checkpoints

BODY = QuadrotorBody()
FACTORS = torch.tensor([1.5, 0.75, 2.0])  # gains of the thrust


def stream(ticks, factors=FACTORS, trace=True):
    """Return ticks of flights whose thrust does more, or less, than it should."""
    generator = torch.Generator().manual_seed(3)
    state = torch.zeros(len(factors), 13).index_fill(1, torch.tensor(9), 1.0)
    result = []
    for _ in range(ticks):
        action = torch.tensor([BODY.hover_thrust, 0.0, 0.0, 0.0]).expand(len(factors), 4).clone()
        action[:, 1:] += 1e-6 * torch.randn(3, generator=generator)
        given = action.clone()
        given[:, 0] *= factors
        path = quadrotor_path(state, given, 0.05, 25, BODY)
        td = TensorDict({"observation": state, "action": action}, [len(factors)])
        td["next", "observation"] = path[-1].clone()
        td["mission"] = TensorDict({"seed": torch.arange(len(factors))}, [len(factors)])
        if trace:
            td["next", "trace"] = torch.cat([state[None], path]).movedim(0, -2)
        result.append(td)
        state = path[-1]
    return result


def teach(ticks=(), missions=3, model=None, **settings):
    model = KNODE(Quadrotor()) if model is None else model
    if missions:
        model.expand_(missions)
    updater = KNODEUpdater(GaussianNLLLoss(model), **{"begin": 0.0, **settings})
    for k, td in enumerate(ticks):
        if k == 0:
            updater.start(td)
        updater(td)
    return model, updater


def missed(model, td):
    """Return the largest error of the acceleration (m/s^2) in a tick, per flight."""
    ahead = model(td["observation"], td["action"])
    return ((ahead - td["next", "observation"])[..., 3:6] / 0.05).abs().amax(-1).detach()


@pytest.mark.parametrize("settings", [{}, {"noise": 0.0}], ids=str)
def test_a_gain_of_the_thrust_is_learnt_in_a_few_updates(settings):
    ticks = stream(11)
    model, updater = teach(ticks[:10], **settings)
    last = ticks[10]
    before = (FACTORS - 1).abs() * BODY.gravity
    torch.testing.assert_close(missed(KNODE(Quadrotor()), last), before, rtol=0.01, atol=0.01)
    assert (missed(model, last) < 0.15 * before).all()
    assert updater.refused == 0


def test_transitions_without_a_trace_will_do():
    ticks = stream(11, trace=False)
    model, _ = teach(ticks[:10])
    assert (missed(model, ticks[10]) < 0.2 * missed(KNODE(Quadrotor()), ticks[10])).all()


def test_a_shared_pool_learns_from_all_flights():
    ticks = stream(5, torch.tensor([1.5, 1.5]))
    model, _ = teach(ticks[:4], missions=0)
    assert model.networks.inner.shape == (3, 17, 64)
    assert (missed(model, ticks[4]) < 1.0).all()
    single, _ = teach([td[0] for td in ticks[:4]], missions=0)
    assert (missed(single, ticks[4]) < 1.0).all()


@pytest.mark.parametrize(
    ("settings", "arrives"),
    [
        ({}, [4, 7]),
        ({"latency": 0.0}, [3, 6, 9]),
        ({"latency": 0.12}, [6, 9]),  # the first tick after 0.12 s
        ({"latency": 0.25}, [8]),  # meanwhile no other is trained
        ({"begin": 0.1}, [6, 9]),
        ({"window": 0.05, "latency": 0.0}, [*range(1, 10)]),
    ],
    ids=str,
)
def test_networks_join_in_simulated_time(settings, arrives):
    """Also in another flight: it begins without the window of the last one, but with its pool."""
    ticks = stream(9)
    model, updater = teach(epochs=1, **settings)
    last = model.networks.inner.clone()
    for _ in range(2):
        updater.start(ticks[0])
        changes = []
        for k, td in enumerate(ticks):
            updater(td)
            if not torch.equal(model.networks.inner, last):
                changes.append(k + 1)  # ticks flown
            last = model.networks.inner.clone()
        assert changes == arrives


def test_a_busy_trainer_leaves_the_latest_rows():
    ticks = stream(9)
    _, updater = teach(ticks[:7], epochs=1, latency=0.25)
    latest = torch.cat([td["next", "trace"][:, :-1] for td in ticks[4:7]], 1)
    assert torch.equal(updater.memory["window", "state"][:, 0], latest)


def test_random_numbers_are_of_the_seed_and_paired_by_missions():
    ticks = stream(4, torch.tensor([1.5, 1.5]))
    (one, _), (same, _), (other, _) = (teach(ticks, missions=2, seed=s) for s in (1, 1, 2))
    assert torch.equal(one.networks.inner, same.networks.inner)
    assert not torch.equal(one.networks.inner, other.networks.inner)
    torch.testing.assert_close(*one.networks.inner, rtol=1e-3, atol=1e-3)
    own, _ = teach(ticks, missions=2, seed_key=["mission", "seed"])
    assert not torch.equal(own.networks.inner[0], own.networks.inner[1])


def test_the_published_numbers_repeat_themselves():
    ticks = stream(3) * 3  # the same window again and again
    settings = {"pool": 1, "units": 8}  # no older networks
    quirk, updater = teach(model=KNODE(Quadrotor(), **settings), published_random=True)
    free, other = teach(model=KNODE(Quadrotor(), **settings))
    found = {quirk: [], free: []}
    for td in ticks:
        for model, learner in ((quirk, updater), (free, other)):
            learner(td)
            found[model].append(model.networks.inner.clone())
    assert torch.equal(found[quirk][3], found[quirk][6])
    assert not torch.equal(found[free][3], found[free][6])


def test_noise_on_the_moments_is_learnt_as_a_turn():
    ticks = stream(5, torch.ones(1))
    turns = []
    for published in (False, True):
        model, _ = teach(ticks[:4], missions=1, published_random=published)
        ahead = model(ticks[4]["observation"], ticks[4]["action"])
        turns.append((ahead - ticks[4]["next", "observation"])[..., 10:].abs().max())
    assert turns[1] > 3 * turns[0]


def test_faulty_steps_of_the_plant_are_left_out():
    ticks = stream(5)
    ticks[1]["next", "trace"][0, 7] = torch.nan
    model, updater = teach(ticks[:4])
    assert updater.refused == 1
    assert all(part.isfinite().all() for part in model.networks)
    assert (missed(model, ticks[4]) < missed(KNODE(Quadrotor()), ticks[4])).all()


@pytest.mark.parametrize("stop", [2, 3, 5])
def test_a_snapshot_goes_on_to_the_bit(stop, tmp_path):
    def agent(model, updater):
        parts = {"env": nn.Module(), "planner": nn.Module(), "device": torch.device("cpu")}
        return SimpleNamespace(model=model, updater=updater, **parts)

    ticks, left = stream(8), torch.tensor([2, 0])
    settings = {"seed_key": ("mission", "seed"), "latency": 0.1}
    whole = agent(*teach(ticks[:2], **settings))
    whole.model.select_(left)  # one flight is over
    ticks = [*ticks[:2], *(td[left] for td in ticks[2:])]
    for td in ticks[2:stop]:
        whole.updater(td)
    loop = Loop(ticks[stop], left, {}, StepLog(["x"]))
    Checkpoints(tmp_path, {}).write(stop, snapshot(whole, loop))
    state = Checkpoints(tmp_path, {}).read()
    for td in ticks[stop:]:
        whole.updater(td)
    second = agent(*teach(**settings))
    second.updater.start(ticks[0])
    restore(second, loop, state)
    for td in ticks[stop:]:
        second.updater(td)
    for one, other in zip(second.model.networks, whole.model.networks, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("frame", ["world", "body"])
def test_the_fast_gradient_is_the_exact_one_to_first_order(frame):
    (td,) = stream(1)
    trace = td["next", "trace"].double()
    state, after = trace[:, :-1].flatten(0, 1), trace[:, 1:].flatten(0, 1)
    action = td["action"].double().unsqueeze(1).expand(-1, 25, -1).flatten(0, 1)
    model = KNODE(Quadrotor(), frame=frame).push_().push_()
    model.double()
    network = model.draw(torch.randn(1, model.numbers, dtype=torch.float64))
    leaves = Network(*(part.requires_grad_() for part in network))
    newest = Network(*(part.squeeze(0) for part in leaves))
    fast = first_order(model, (state, action, after), 0.002)(leaves)
    exact = model.advance(state, action, 0.002, newest=newest) - after  # through the integration
    found = []
    for error in (fast, exact):
        slopes = torch.autograd.grad(error.square().sum(), leaves)
        found.append(torch.cat([part.flatten() for part in slopes]))
    assert (found[0] - found[1]).norm() < 0.05 * found[1].norm()


def test_the_weights_decay(monkeypatch):
    (td,) = stream(1)
    rows = td["observation"], td["action"], td["next", "observation"]
    model = KNODE(Quadrotor())
    start = model.draw(torch.randn(1, model.numbers))
    none = torch.zeros(3, dtype=torch.bool)  # no row counts
    settings = {"epochs": 5, "lr": 0.01}
    decayed = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(knode_fit, "DECAY", share)
        decayed.append(fit_network(model, start, rows, none, 0.05, **settings).inner)
    assert torch.equal(decayed[0], start.inner)
    assert decayed[1].abs().sum() < start.inner.abs().sum()
