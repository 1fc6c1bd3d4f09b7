"""What cannot be used is refused where it is given, by name and value."""

import math
import re
from functools import partial

import pytest
import torch
from harness import BOX
from tensordict import TensorDict
from torchrl.envs import GymEnv

from afm_rl import learning
from afm_rl.correction import ActionFlow, LeastSquares, PaperFlow
from afm_rl.correction.paper_flow import midpoint
from afm_rl.correction.training import train_flow
from afm_rl.dynamics import KNODE, Calibrated, Dubins, Ensemble, KnownDynamics, Quadrotor
from afm_rl.dynamics.stacked import RunningStats
from afm_rl.envs import skid_steer
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, Updater, UpdaterHook
from afm_rl.planning import (
    CEM,
    ICEM,
    MPC,
    MPPI,
    GoalDistance,
    KnownReward,
    PlanningEnv,
    TrackingCost,
)
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

CAR, ONES = Manifold(3, angles=[2]), torch.ones(2)


def ensemble(**settings):
    return Ensemble(CAR, **{"action_size": 2, "features": [2], "hidden": [4], **settings})


def added(**settings):
    return KnownDynamics(torch.add, CAR, 2, **settings)


def networks(**settings):
    return KNODE(Quadrotor(), **settings)


def seen(*given):
    RunningStats(3, lead=(2,)).update_(*given)


def trained(states, flow=None):
    train_flow(flow or PaperFlow(*BOX, [2], 3, gate=0.1), Dubins(), states)


def world(cost=None, *box):
    return PlanningEnv(Dubins(), cost or GoalDistance(), *(box or BOX))


def plans(kind, cost=None, **settings):
    return kind(world(cost), **settings)


def taught(model, kind, *settings, **more):
    return kind(GaussianNLLLoss(model), *settings, **more)


GRADIENT = partial(OnlineUpdater, optimizer=learning.ResetAdam)


def beside(scale=(1.0, 1.5), updater=GRADIENT):
    return taught(ensemble(), learning.UnmatchedUpdater, updater, scale)


def one_row():
    driven = torch.zeros(1, 3)
    parts = {"observation": driven, "action": driven[:, :2], ("next", "observation"): driven}
    return TensorDict(parts, [1])


def tracking(coordinates=(0, 1), **settings):
    return TrackingCost([1.0, 1.0, 0.0], [0.1, 0.1], coordinates, **settings)


REFUSED = {
    "corrector.features=[3]: expected indices of": lambda: PaperFlow(*BOX, [3], 3),
    "corrector.steps=0": lambda: midpoint(lambda tau, x: x, ONES, 0),
    "corrector.home=[0.5]: expected 2 actions between": lambda: ActionFlow(*BOX, home=[0.5]),
    "corrector.home=[0.5, 2.0]: expected 2 actions": lambda: ActionFlow(*BOX, home=[0.5, 2.0]),
    "expected a PaperFlow, got ActionFlow": lambda: trained((ONES, ONES), ActionFlow(*BOX)),
    "states=[1.0, 1.0]: expected finite states of 3": lambda: trained((ONES, ONES)),
    "expected finite states of 3 numbers": lambda: trained(
        (torch.zeros(3), math.inf * torch.ones(3))
    ),
    "dynamics.action_size=0": lambda: ensemble(action_size=0),
    "dynamics.features=['x']": lambda: ensemble(features=["x"]),
    "dynamics.log_variance=[1.0]": lambda: ensemble(log_variance=[1]),
    "dynamics.step=3": lambda: KnownDynamics(3, CAR, 2),
    "dynamics.noise_std=[1.0, 2.0]: expected one number, or 3": lambda: added(noise_std=[1, 2]),
    "body='crazyflie': expected a QuadrotorBody": lambda: Quadrotor(body="crazyflie"),
    "holds (3,) missions": lambda: Calibrated(ensemble().expand_(3), ONES),
    "dynamics.half_range=[1.0, 1.0, 1.0]: expected 2 numbers > 0": lambda: Calibrated(
        Dubins(), torch.ones(3)
    ),
    "dynamics.half_range=[1.0, 0.0]": lambda: Calibrated(Dubins(), torch.tensor([1.0, 0.0])),
    "dynamics.features=[1, 1]: expected distinct": lambda: networks(features=[1, 1]),
    "dynamics.frame='body': expected 'world'": lambda: KNODE(Dubins(), torch.add, frame="body"),
    "dynamics.rate=None: expected the rate of change of Dubins": lambda: KNODE(Dubins()),
    "dynamics.dt=None: KnownDynamics has no dt": lambda: KNODE(added(), torch.add),
    "count": lambda: RunningStats(3).start_(torch.zeros(3), torch.ones(3), 0),
    "values of shape (3, 3): expected (2, ..., 3)": lambda: seen(torch.zeros(3, 3)),
    "values of shape (2, 4): expected (2, ..., 3)": lambda: seen(torch.zeros(2, 4)),
    "where of shape (3,): expected (2,)": lambda: seen(torch.zeros(2, 3), torch.ones(3) > 0),
    "dynamics.dt": lambda: skid_steer(dt=0.001),
    "cost.coordinates=[0]: expected at least one per goal": lambda: GoalDistance([0]),
    "cost.weights=[1.0]: expected 2 numbers": lambda: GoalDistance(weights=[1]),
    "cost.coordinates=[0, 3]: expected distinct indices in 0..2": lambda: tracking([0, 3]),
    "cost.angles=[3]": lambda: tracking(angles=[3]),
    "cost.rest=[0.0]: expected 3 numbers": lambda: tracking(rest=[0.0]),
    "in_sizes=[]: expected one for each": lambda: KnownReward(lambda *_: 0, in_keys=["goal"]),
    "cost.in_keys=[]: expected one key": lambda: tracking(in_keys=[]),
    "planner.elites=51: expected at most half of": lambda: plans(ICEM, elites=51),
    "planner.elites=301: expected at most planner": lambda: plans(CEM, elites=301),
    "planner.bounded=[2]: expected distinct indices in 0..1": lambda: plans(
        MPC, tracking(), bounded=[2]
    ),
    "planner.env: dynamics: expected a DynamicsModel, got None": lambda: PlanningEnv(
        None, GoalDistance(), *BOX
    ),
    "planner.env: cost: expected a Cost, got None": lambda: PlanningEnv(Dubins(), None, *BOX),
    "cost.in_keys=['observation']: 'observation' is the state": lambda: world(
        GoalDistance(in_keys=["observation"])
    ),
    "planner.env: expected a EnvBase, got 1": lambda: MPPI(1),
    "planner: got NoneType": lambda: MPC(None),
    "got Dubins; MPC needs": lambda: MPC(Dubins()),
    "PlanningEnv with GoalDistance; MPC needs": lambda: plans(MPC),
    "there are 3 and 2": lambda: plans(MPC, TrackingCost([1.0], [1.0], [0])),
    "key 5: expected a text": lambda: plans(MPPI, action_key=5),
    "loss.model: expected a DynamicsModel, got None": lambda: GaussianNLLLoss(None),
    "updater.loss: expected a GaussianNLLLoss, got None": lambda: Updater(None),
    "updater.optimizer=None": lambda: OnlineUpdater(GaussianNLLLoss(ensemble()), None),
    "updater: expected a Updater, got None": lambda: UpdaterHook(None),
    "of the control tick": lambda: taught(networks(), learning.KNODEUpdater, window=0.01),
    "trains a KNODE, got Dubins": lambda: taught(Dubins(), learning.KNODEUpdater),
    "updates a Calibrated model, got Dubins": lambda: taught(Dubins(), learning.RLSUpdater),
    "trains an Ensemble, got Dubins": lambda: taught(Dubins(), learning.StreamXUpdater),
    "updater.scale=[1.0]: expected 2 positive": lambda: beside([1.0]),
    "updater.scale=[1.0, 0.0]": lambda: beside([1.0, 0.0]),
    "updater.updater": lambda: beside(updater=lambda loss: loss),
    "before you expand it to 4 missions": lambda: learning.pretrain_knode(
        networks().expand_(4), Quadrotor(), BOX, BOX
    ),
    "dynamics.pretrain.samples=63": lambda: learning.pretrain_ensemble(
        ensemble(), Dubins(), (-torch.ones(3), torch.ones(3)), BOX, samples=63, batch_size=64
    ),
    "transitions=1": lambda: learning.fit_ensemble(ensemble(), one_row()),
    "frames=0": lambda: learning.collect(GymEnv("Pendulum-v1"), frames=0),
    "transform.model: expected a DynamicsModel, got None": lambda: ActionFlowTransform(
        None, LeastSquares(*BOX)
    ),
    "transform.corrector: expected a Corrector, got 3": lambda: ActionFlowTransform(Dubins(), 3),
    "key ('afm', 1): expected a text": lambda: ActionFlowTransform(Dubins(), prefix=("afm", 1)),
    "in_keys=[]: expected one key": lambda: ActionFlowTransform(Dubins(), in_keys=[]),
    "in_keys_inv=['a', 'b']: expected one key": lambda: ActionFlowTransform(
        Dubins(), in_keys_inv=["a", "b"]
    ),
}


@pytest.mark.parametrize(("message", "make"), REFUSED.items(), ids=REFUSED)
def test_it_is_refused(message, make):
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        make()


BOXES = {
    "corrector": lambda *box: LeastSquares(*map(torch.tensor, box)),
    "planner": lambda *box: world(None, *box),
}


@pytest.mark.parametrize("taker", BOXES)
@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([-1.0], [1.0, 1.0]),
        ([1.0, -1.0], [-1.0, 1.0]),
        ([-1.0, 1.0], [1.0, 1.0]),
        ([math.nan, -1.0], [1.0, 1.0]),
        ([-math.inf, -1.0], [1.0, 1.0]),
        ([[-1.0]], [[1.0]]),
        ([], []),
    ],
    ids=str,
)
def test_impossible_boxes_are_refused(taker, low, high):
    with pytest.raises(ConfigurationError, match="action bounds"):
        BOXES[taker](low, high)
