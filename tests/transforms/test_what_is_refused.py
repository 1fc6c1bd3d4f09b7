"""What shells cannot use is refused where it is given, by name and value."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from puck import Puck, push
from torchrl.data import Unbounded
from torchrl.envs import GymEnv, TransformedEnv

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, check_model
from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.dynamics import Dubins, KnownDynamics, MuJoCoDynamics
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform, RegimeTransform

ONES = torch.ones(2)
CART = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body>
</worldbody><actuator><motor joint="x"/></actuator></mujoco>"""


def transform(**settings):
    return ActionFlowTransform(Dubins(), LeastSquares([-1.0, -1.5], [1.0, 1.5]), **settings)


def track(**settings):
    TransformedEnv(UGVTrack(), transform(**settings)).reset()


def unbounded():
    world = PlanningEnv(Dubins(), GoalDistance(), -ONES, ONES)
    world.action_spec = Unbounded((2,))
    TransformedEnv(world, ActionFlowTransform(Dubins())).reset()


def wrapped(model=push, action_space=None, nested=False, **settings):
    env = Puck(nested=nested)
    env.action_space = action_space or env.action_space
    ActionFlowWrapper(env, model, **settings).reset()


def rescaled():
    pytest.importorskip("mujoco")
    env = gymnasium.wrappers.RescaleAction(gymnasium.make("InvertedPendulum-v5"), -1, 1)
    ActionFlowWrapper(env)


def stepped(action, seen=None):
    env = ActionFlowWrapper(Puck(), push)
    env.reset(seed=0)
    if seen is not None:
        env.unwrapped._seen = lambda: seen
    env.step(action)


def vector():
    return gymnasium.vector.SyncVectorEnv([Puck] * 3)


def three_for_two():
    envs = ActionFlowVectorWrapper(vector(), push)
    envs.reset()
    envs.step(np.zeros((2, 2)))


def regime(phases, at):
    return RegimeTransform(ActionGain(["torque"]), phases, at=at)


REFUSED = [
    # the transform
    ("expected the 2 finite bounds", unbounded),
    (r"\['goal'\]: of the shape \(2,\), .* has 3 num", lambda: track(in_keys=["goal"])),
    (r"\['pos'\]: the environment has no .*'pose'", lambda: track(in_keys=["pos"])),
    (r"\['act'\]: the environment has no .*'action'", lambda: track(in_keys_inv=["act"])),
    (
        r"transform.max_correction=\[0.1\]: expected one number, or 2",
        lambda: transform(max_correction=[0.1]),
    ),
    (
        "transform.max_correction_rate=0.1: with reported_key",
        lambda: transform(max_correction_rate=0.1, reported_key="given"),
    ),
    # wrappers
    ("Discrete", lambda: wrapped(action_space=Discrete(2))),
    ("finite bounds", lambda: wrapped(action_space=Box(-np.inf, np.inf, (2,)))),
    (r"Dict.*state=lambda", lambda: wrapped(nested=True)),
    ("has no MuJoCo model", lambda: wrapped("mujoco")),
    ("'mujoco', 'learn'", lambda: wrapped("musculoskeletal")),
    (r"state has \(4,\) numbers, that of the model 3", lambda: wrapped(Dubins())),
    ("3 finite bounds", lambda: wrapped(KnownDynamics(push, Manifold(4), 3))),
    ("inside of those that change actions", rescaled),
    ("delay=.*one number of steps, or 2", lambda: wrapped(delay=[1, 2, 3])),
    (
        "has no causes to believe in: give an ActionFlow",
        lambda: wrapped(belief=True, corrector=LeastSquares(-ONES, ONES)),
    ),
    ("SyncVectorEnv.*for ActionFlowVectorWrapper", lambda: ActionFlowWrapper(vector(), push)),
    ("Puck: .*for ActionFlowWrapper", lambda: ActionFlowVectorWrapper(Puck(), push)),
    ("'max_corection'.*did you mean 'max_correction'", lambda: wrapped(max_corection=0.1)),
    ("Puck.*state=lambda", lambda: wrapped(MuJoCoDynamics(CART))),
    ("a corrector was given too", lambda: wrapped(delay=2, corrector=ActionFlow(-ONES, ONES))),
    # what they are given at a step
    ("'action': str, expected real numbers", lambda: stepped("left")),
    ("'action': torch.float64 .1,., expected .* .2,.", lambda: stepped([0.3])),
    ("'action': list, expected real numbers", lambda: stepped([[1.0], [1.0, 2.0]])),
    (r"'observation': .* \(3,\), expected .* \(4,\)", lambda: stepped([0, 0], np.zeros(3))),
    (r"'actions': .* \(2, 2\), expected .* \(3, 2\)", three_for_two),
    # the check of a model
    ("model='learn': there is no model yet", lambda: check_model(Puck(), "learn")),
    ("steps=0", lambda: check_model(Puck(), push, steps=0)),
    ("'action': .*, expected", lambda: check_model(Puck(), push, lambda seen: seen)),
    ("'learn': expected 'mujoco', a step function", lambda: check_model(UGVTrack(), "learn")),
    ("state='pos': the environment has no", lambda: check_model(UGVTrack(), Dubins(), state="pos")),
    ("no MuJoCo model", lambda: check_model(GymEnv("Pendulum-v1"))),
    # regimes
    (r"phases=.*one more than at=.*torque", lambda: regime([{}], [3])),
    (r"phases=.*one more than at=.*torque", lambda: regime(torch.ones(2, 2), [3])),
]


@pytest.mark.parametrize(("match", "make"), REFUSED)
def test_it_is_refused(match, make):
    with pytest.raises(ConfigurationError, match=match):
        make()
