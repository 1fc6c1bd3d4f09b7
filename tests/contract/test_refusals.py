"""What cannot be used is refused where it is given, by name and value."""

import re

import pytest
from harness import BOX

from afm_rl.correction import ActionFlow, LeastSquares, PaperFlow
from afm_rl.dynamics import Dubins, Ensemble, KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, Updater, UpdaterHook
from afm_rl.planning import CEM, ICEM, MPC, MPPI, GoalDistance, PlanningEnv, TrackingCost
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

CAR = Manifold(3, angles=[2])


def ensemble(**settings):
    return Ensemble(CAR, **{"action_size": 2, "features": [2], "hidden": [4], **settings})


def plans(kind, **settings):
    return kind(PlanningEnv(Dubins(), GoalDistance(), *BOX), **settings)


def tracking(coordinates=(0, 1), **settings):
    return TrackingCost([1.0, 1.0, 0.0], [0.1, 0.1], coordinates, **settings)


REFUSED = {
    "corrector.memory=19: expected at least": lambda: ActionFlow(*BOX, memory=19),
    "corrector.delay=[1]: expected one number of steps, or 2": lambda: ActionFlow(*BOX, delay=[1]),
    "corrector.features=[3]: expected indices of": lambda: PaperFlow(*BOX, [3], 3),
    "dynamics.action_size=0": lambda: ensemble(action_size=0),
    "dynamics.features=['x']": lambda: ensemble(features=["x"]),
    "dynamics.features=[3]": lambda: ensemble(features=[3]),
    "dynamics.log_variance=[1.0]": lambda: ensemble(log_variance=[1]),
    "dynamics.step=3": lambda: KnownDynamics(3, CAR, 2),
    "cost.coordinates=[0]: expected at least one per goal": lambda: GoalDistance([0]),
    "cost.weights=[1.0]: expected 2 numbers": lambda: GoalDistance(weights=[1]),
    "cost.coordinates=[0, 3]: expected distinct indices in 0..2": lambda: tracking([0, 3]),
    "cost.coordinates=[0, 0]": lambda: tracking([0, 0]),
    "cost.angles=[3]": lambda: tracking(angles=[3]),
    "cost.rest=[0.0]: expected 3 numbers": lambda: tracking(rest=[0.0]),
    "cost.in_keys=[]: expected one key": lambda: tracking(in_keys=[]),
    "planner.elites=51: expected at most half of": lambda: plans(ICEM, elites=51),
    "planner.elites=301: expected at most planner": lambda: plans(CEM, elites=301),
    "planner.bounded=[2]: expected distinct indices in 0..1": lambda: MPC(
        PlanningEnv(Dubins(), tracking(), *BOX), bounded=[2]
    ),
    "planner.env: dynamics: expected a DynamicsModel, got None": lambda: PlanningEnv(
        None, GoalDistance(), *BOX
    ),
    "planner.env: cost: expected a Cost, got None": lambda: PlanningEnv(Dubins(), None, *BOX),
    "cost.in_keys=['observation']: 'observation' holds the state": lambda: PlanningEnv(
        Dubins(), GoalDistance(in_keys=["observation"]), *BOX
    ),
    "planner.env: expected a EnvBase, got 1": lambda: MPPI(1),
    "planner.env: expected a EnvBase, got 2": lambda: ICEM(2),
    "planner.env: expected a EnvBase, got 3": lambda: CEM(3),
    "planner: got NoneType": lambda: MPC(None),
    "key 5: expected a text": lambda: MPPI(
        PlanningEnv(Dubins(), GoalDistance(), *BOX), action_key=5
    ),
    "loss.model: expected a DynamicsModel, got None": lambda: GaussianNLLLoss(None),
    "updater.loss: expected a GaussianNLLLoss, got None": lambda: Updater(None),
    "updater.optimizer=None": lambda: OnlineUpdater(GaussianNLLLoss(ensemble()), None),
    "updater: expected a Updater, got None": lambda: UpdaterHook(None),
    "transform.model: expected a DynamicsModel, got None": lambda: ActionFlowTransform(
        None, LeastSquares(*BOX)
    ),
    "transform.corrector: expected a Corrector, got 3": lambda: ActionFlowTransform(Dubins(), 3),
    "made for 1 actions, but the dynamics model has 2": lambda: ActionFlowTransform(
        Dubins(), LeastSquares([-1.0], [1.0])
    ),
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
