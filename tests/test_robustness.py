"""Faulty sensors, outliers and the seam of the heading, in the closed loop."""

import copy
import math
import warnings

import torch
from tensordict import TensorDict
from torchrl.envs import Compose, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.transforms import ActionFlowTransform

FAULTS = [math.nan, math.inf, -math.inf, 1e30]
COORDINATES = [[0], [2], [0, 1, 2]]


class FaultySensor(Transform):
    """Replaces coordinates of the observation; mission i shows a fault of its own at step i."""

    def __init__(self, cases):
        super().__init__(in_keys=["observation"])
        self.cases = cases

    def _step(self, tensordict, next_tensordict):
        seen = next_tensordict["observation"].clone()
        for mission, (fault, coordinates) in enumerate(self.cases):
            if int(next_tensordict["step"][mission]) == when(mission):
                seen[mission, coordinates] = fault
        return next_tensordict.set("observation", seen)

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def when(mission):
    """The step at which a mission's sensor fails."""
    return 3 + mission % 5


def flat(model, mission):
    return torch.cat([parameter.data[mission].flatten() for parameter in model.parameters()])


def test_a_faulty_observation_is_survived_and_not_learned(universal_flow, trained_ensemble, box):
    cases = [(fault, where) for fault in FAULTS for where in COORDINATES]
    model = trained_ensemble.expand_(len(cases))
    planner = MPPI(PlanningEnv(model, GoalDistance(), *box), horizon=4, population=24)
    base = UGVTrack(
        batch_size=(len(cases),), schedule=Schedule([]), missions={"regime": {"v_gain": -1.0}}
    )
    chain = [FaultySensor(cases), ActionFlowTransform(model, universal_flow)]
    env = TransformedEnv(base, Compose(*chain, planner.make_tensordict_primer()))
    loss = GaussianNLLLoss(model)
    loss.set_keys(action=("next", "afm", "executed_action"))
    updater = OnlineUpdater(loss, lambda p: ResetAdam(p, lr=1e-3))
    td, learned = env.reset(), []
    for _ in range(14):
        before = [flat(model, mission) for mission in range(len(cases))]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # plans without a finite return are announced
            td = env.step(planner(td))
        executed = td["next", "afm", "executed_action"]
        assert executed.isfinite().all() and td["action"].isfinite().all()
        assert all(base.action_spec.space.low[0] <= executed.amin(0))
        assert all(executed.amax(0) <= base.action_spec.space.high[0])
        updater(td)
        after = [flat(model, mission) for mission in range(len(cases))]
        assert all(weights.isfinite().all() for weights in after)
        pairs = zip(before, after, strict=True)
        learned.append([not torch.equal(left, right) for left, right in pairs])
        td = step_mdp(td)
    assert updater.refused == 2 * len(cases)  # each fault ends one transition and begins one
    for mission, steps in enumerate(zip(*learned, strict=True)):
        still = [step for step, moved in enumerate(steps) if not moved]
        assert still == [when(mission) - 1, when(mission)]
    assert td["pose"].isfinite().all()


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


def test_turning_through_the_seam_is_no_misalignment(universal_flow):
    env = TransformedEnv(UGVTrack(batch_size=(40,)), ActionFlowTransform(Dubins(), universal_flow))
    td, crossings = env.reset(), 0
    for _ in range(60):
        td["action"] = torch.tensor([0.1, 1.5]).expand(40, 2)
        td = env.step(td)
        crossings += int((td["next", "pose"][:, 2] < td["pose"][:, 2]).sum())
        assert not td["next", "afm", "misaligned"].any()
        td = step_mdp(td)
    assert crossings >= 100
