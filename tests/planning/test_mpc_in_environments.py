"""Model predictive control as a policy: its plan travels with the tensordict."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp
from torchrl.modules.utils import get_primers_from_module

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.planning import MPC, PlanningEnv, TrackingCost

STATES, ACTIONS = ("mpc", "states"), ("mpc", "actions")


@pytest.fixture
def planner(box):
    cost = TrackingCost([1.0, 1.0, 0.0], [0.02, 0.02], [0, 1], in_keys=["goal"])
    return MPC(PlanningEnv(Dubins(), cost, *box), horizon=4)


def track(planner, **settings):
    return TransformedEnv(UGVTrack(**settings), planner.make_tensordict_primer())


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)], ids=str)
def test_it_is_a_policy_for_any_batch(planner, batch):
    env = track(planner, batch_size=batch, max_steps=3)
    check_env_specs(env)
    data = env.rollout(5, planner, break_when_any_done=False)
    assert data[STATES].shape == (*batch, 5, 5, 3) and data[ACTIONS].shape == (*batch, 5, 4, 2)
    assert (data[STATES][..., [0, 3], :, :] == 0).all()  # resets
    assert torch.equal(
        data[STATES][..., [1, 2, 4], :, :], data["next", *STATES][..., [0, 1, 3], :, :]
    )


def test_double_precision_stays_where_the_observation_has_it(box):
    cost = TrackingCost([1.0, 1.0, 0.0], [0.02, 0.02], [0, 1], in_keys=["goal"])
    double = [bound.double() for bound in box]
    planner = MPC(PlanningEnv(Dubins(), cost, *double), horizon=4)
    env = track(planner, dtype=torch.float64)
    data = env.rollout(3, planner)
    assert data["action"].dtype == data[STATES].dtype == torch.float64


def test_torchrl_finds_the_primer(planner):
    env = TransformedEnv(UGVTrack(batch_size=(2,)), get_primers_from_module(planner))
    assert env.reset()[STATES].shape == (2, 5, 3)


def test_a_partial_reset_clears_its_own_rows_only(planner):
    env = track(planner, batch_size=(3,))
    td = step_mdp(env.step(planner(env.reset())))
    before = td[ACTIONS].clone()
    td["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(td)[ACTIONS]
    assert (after[1] == 0).all() and torch.equal(after[[0, 2]], before[[0, 2]])


def test_a_batch_unlocked_environment_takes_the_batch_of_the_reset(planner):
    env = track(planner)
    td = planner(env.reset(TensorDict(batch_size=[5]), set_state=False))
    assert td["action"].shape == (5, 2) and td["next", *STATES].shape == (5, 5, 3)


def test_environments_in_series_have_plans_of_their_own(planner):
    env = SerialEnv(2, lambda: track(planner, max_steps=3))
    data = env.rollout(5, planner, break_when_any_done=False)
    assert data[STATES].shape == (2, 5, 5, 3) and (data[STATES][:, 3] == 0).all()


def test_it_rolls_out_in_its_own_world(planner):
    env = TransformedEnv(planner.env, planner.make_tensordict_primer())
    start = TensorDict({"observation": torch.zeros(3, 3), "goal": torch.ones(3, 2)}, [3])
    data = env.rollout(20, planner, tensordict=env.reset(start), auto_reset=False)
    gap = data["next", "observation"][:, -1, :2] - data["goal"][:, -1]
    assert (gap.norm(dim=-1) < 0.2).all()
