"""Faulty sensors, outliers and the seam of the heading, in the closed loop."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.transforms import ActionFlowTransform


@pytest.mark.slow
def test_outliers_do_little_harm(trained_ensemble, transitions):
    error = {}
    for share in (0.0, 0.01):
        model = copy.deepcopy(trained_ensemble)
        updater = OnlineUpdater(GaussianNLLLoss(model), lambda p: ResetAdam(p, lr=1e-4))
        dice = torch.Generator().manual_seed(0)
        gain = torch.tensor([0.6, 1.2])
        state, action = transitions(1000, seed=1)
        change = Dubins()(state, gain * action) - state
        wild = torch.rand(1000, generator=dice) < share
        change = torch.where(wild.unsqueeze(-1), 100 * change, change)
        rows = TensorDict({"observation": state, "action": action}, [1000])
        rows["next", "observation"] = state + change
        for row in rows.split(1):
            updater(row)
        state, action = transitions(500, seed=2)
        miss = model.manifold.difference(model(state, action), Dubins()(state, gain * action))
        error[share] = float(miss.square().mean().sqrt())
        assert updater.refused == 0
    assert error[0.01] < 1.5 * error[0.0]


def test_turning_through_the_seam_is_no_misalignment(flow):
    env = TransformedEnv(UGVTrack(batch_size=(40,)), ActionFlowTransform(Dubins(), flow))
    td, crossings = env.reset(), 0
    for _ in range(60):
        td["action"] = torch.tensor([0.1, 1.5]).expand(40, 2)
        td = env.step(td)
        crossings += int((td["next", "pose"][:, 2] < td["pose"][:, 2]).sum())
        assert not td["next", "afm", "corrected"].any()
        td = step_mdp(td)
    assert crossings >= 100
