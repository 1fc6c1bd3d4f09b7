"""Planners as policies: a plan travels with the tensordict."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp
from torchrl.modules.utils import get_primers_from_module

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.planning import MPC, MPPI, GoalDistance, PlanningEnv, TrackingCost

PLANS = {"mppi": ("mppi", "mean"), "mpc": ("mpc", "actions")}


def make(kind, box):
    if kind == "mppi":
        world = PlanningEnv(Dubins(), GoalDistance(), *box)
        return MPPI(world, horizon=4, candidates=16, seed_key=["mission", "seed"])
    cost = TrackingCost([1.0, 1.0, 0.0], [0.02, 0.02], [0, 1], in_keys=["goal"])
    return MPC(PlanningEnv(Dubins(), cost, *box), horizon=4)


@pytest.fixture(params=PLANS)
def kind(request):
    return request.param


@pytest.fixture
def planner(kind, box):
    return make(kind, box)


def track(planner, **settings):
    return TransformedEnv(UGVTrack(**settings), planner.make_tensordict_primer())


def test_torchrl_finds_the_primer(planner, kind):
    primer = get_primers_from_module(planner)
    env = TransformedEnv(UGVTrack(batch_size=(2,)), primer)
    assert env.reset()[PLANS[kind]].shape == (2, 4, 2)


def test_the_plan_is_zero_at_resets_and_carried_between(planner, kind):
    env = track(planner, batch_size=(3,), max_steps=4)
    data = env.rollout(10, planner, break_when_any_done=False)
    now, later = data[PLANS[kind]], data["next", *PLANS[kind]]
    fresh = torch.arange(10) % 4 == 0
    assert (now[:, fresh] == 0).all() and (later != 0).any(-1).all()
    carried = torch.arange(1, 10)[~fresh[1:]]
    assert torch.equal(now[:, carried], later[:, carried - 1])


def test_a_partial_reset_clears_its_own_rows_only(planner, kind):
    env = track(planner, batch_size=(3,))
    td = step_mdp(env.step(planner(env.reset())))
    before = td[PLANS[kind]].clone()
    td["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(td)[PLANS[kind]]
    assert (after[1] == 0).all() and torch.equal(after[[0, 2]], before[[0, 2]])


def test_a_batch_unlocked_environment_takes_the_batch_of_the_reset(planner, kind):
    env = track(planner)
    td = env.reset(TensorDict(batch_size=[5]), set_state=False)
    assert td[PLANS[kind]].shape == (5, 4, 2)
    td = step_mdp(env.step(planner(td)))
    td = td[torch.tensor([0, 3])]  # missions that are done leave
    assert env.step(planner(td))["next", *PLANS[kind]].shape == (2, 4, 2)


def test_a_missing_plan_is_told_once_and_taken_as_zero(planner, kind, box):
    td = TensorDict({"observation": torch.zeros(2, 3), "goal": torch.ones(2, 2)}, [2])
    expected = planner(planner.make_tensordict_primer()(td.clone()))["action"]
    planner = make(kind, box)
    with pytest.warns(UserWarning, match=rf"no \('{kind}', .*make_tensordict_primer"):
        found = planner(td.clone())["action"]
    torch.testing.assert_close(found, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        planner(td.clone())
