"""The first healthy steps fit the model, once, in whichever shell; a fault is not learnt."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from puck import Puck, play, push
from shells import BOX, MODEL, SHELLS, plans_of, pucks
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import check_env_specs

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, FaultWrapper
from afm_rl.dynamics import LinearResidual, MuJoCoDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform
from afm_rl.transforms.controller import Controller

STEPS = 50  # the fewest that are accepted
pytestmark = pytest.mark.filterwarnings("ignore:.*of the first 60 steps were corrected")


def told_by(env, steps, seed=0):
    """Act at random; return what is said of each step."""
    return [info["afm"] for *_, info in play(env, steps, seed)]


def column(told, name):
    return np.array([each[name] for each in told])


def test_once_the_steps_are_there_the_healthy_robot_is_left_alone():
    env, plain = (ActionFlowWrapper(Puck(gain=0.8), push, residual_steps=n) for n in (STEPS, 0))
    assert env.residual is None
    told = told_by(env, 120)
    executed = column(told, "executed_action")[:STEPS]  # till then as without the option
    np.testing.assert_array_equal(executed, column(told_by(plain, STEPS), "executed_action"))
    corrects, fitted = column(told, "corrected"), column(told, "fitted")
    assert corrects[20:STEPS].mean() > 0.5 and not corrects[STEPS:].any()
    assert not fitted[:STEPS].any() and fitted[STEPS:].all()
    assert env.residual.since == STEPS and env.residual.suspect == ""
    assert (env.residual.explained[2:] > 0.9).all()
    told_by(env, 5, seed=1)  # it stays fitted
    assert env.residual.since == STEPS


def test_a_fault_that_is_there_from_the_start_is_not_learnt():
    env = ActionFlowWrapper(Puck(gain=-1.0), push, residual_steps=STEPS)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        told = told_by(env, STEPS + 51)
    texts = [str(one.message) for one in said if "residual_steps" in str(one.message)]
    assert "not adjusted: these 50 steps look like all reversed" in texts[0]
    assert not column(told, "fitted").any() and column(told, "corrected")[10:].all()
    assert env.residual.suspect == "all reversed" and env.residual.since == -1


def test_a_fault_after_the_fit_is_corrected():
    robot = FaultWrapper(Puck(gain=0.9), "all reversed", at=STEPS + 20)
    told = told_by(ActionFlowWrapper(robot, push, residual_steps=STEPS), 120)
    corrects = column(told, "corrected")
    assert not corrects[STEPS : STEPS + 20].any() and corrects[STEPS + 30 :].all()
    last = told[-1]
    np.testing.assert_allclose(last["executed_action"], -last["planned_action"], atol=0.2)


def test_each_robot_of_a_vector_has_a_fit_of_its_own():
    makers = [lambda g=g: Puck(gain=g, ends=40) for g in (0.8, 1.2, -1.0)]
    envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs = ActionFlowVectorWrapper(envs, push, residual_steps=STEPS)
    with pytest.warns(UserWarning, match="look like all reversed"):
        told = told_by(envs, 100)
    assert column(told, "fitted")[-1].tolist() == [True, True, False]
    assert envs.residual.suspect == ["", "", "all reversed"]
    assert not column(told, "corrected")[STEPS + 5 :, :2].any()
    model, state = envs.loop.model, torch.randn(5, 4).double()
    action = torch.rand(5, 2).double()
    for row, gain in enumerate((0.8, 1.2)):
        missed = (model.of(row)(state, action) - push(state, gain * action)).abs().mean()
        assert missed < 0.2 * (push(state, action) - push(state, gain * action)).abs().mean()


@pytest.mark.check
@pytest.mark.parametrize("name", ["transform", "policy"])  # wrappers: see above
def test_other_shells_leave_the_healthy_robot_alone(name):
    plans = plans_of(100)
    executed = torch.stack(
        [*SHELLS[name](plans, torch.float32, gain=0.8, ends=1000, residual_steps=STEPS)]
    )
    changed = (executed - plans).abs().amax(-1) > 1e-6
    assert bool(changed[30:STEPS].any()) and not bool(changed[STEPS + 2 :].any()), name


@pytest.mark.parametrize("at", [30, 80])
def test_an_interrupted_collection_continues(at):
    env, other = (ActionFlowWrapper(Puck(gain=0.8), push, residual_steps=STEPS) for _ in range(2))
    told_by(env, at)
    other.reset(seed=0)
    other.load_state_dict(env.state_dict())
    other.unwrapped.state = env.unwrapped.state.copy()
    rest = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    one, two = ([e.step(a)[-1]["afm"] for a in rest] for e in (env, other))
    np.testing.assert_array_equal(column(one, "executed_action"), column(two, "executed_action"))
    assert column(one, "fitted").tolist() == column(two, "fitted").tolist()
    assert one[-1]["fitted"]


def test_the_fit_is_a_part_of_state_dicts():
    module = ActionFlowPolicy(MODEL, Bounded(*BOX), residual_steps=STEPS)
    module.make_tensordict_primer()(TensorDict())
    module.loop.residual.seen["count"] += 7
    other = ActionFlowPolicy(MODEL, Bounded(*BOX), residual_steps=STEPS)
    other.load_state_dict(module.state_dict())
    assert int(other.residual.steps) == 7


def test_the_transform_tells_whether_the_model_is_fitted():
    env = pucks(0.8, ActionFlowTransform(MODEL, residual_steps=STEPS))
    check_env_specs(env)
    data = env.rollout(70, break_when_any_done=False)
    assert data["afm", "fitted"].shape == data.batch_size
    assert env.transform.residual.steps > 0


def test_a_fitted_model_of_a_simulation_reads_its_state():
    env = gymnasium.make("InvertedPendulum-v5")
    model = LinearResidual(MuJoCoDynamics(env))
    wrapped = ActionFlowWrapper(env, model)
    wrapped.reset(seed=0)
    assert wrapped.memory is not None and not wrapped.step(np.zeros(1, np.float32))[2]


REFUSED = {
    "expected 0, or at least 50 steps": lambda: ActionFlowWrapper(Puck(), push, residual_steps=20),
    "leave it out with model='learn'": lambda: ActionFlowWrapper(
        Puck(), "learn", residual_steps=60
    ).reset(),
    "the model was fitted before": lambda: ActionFlowPolicy(
        LinearResidual(MODEL), Bounded(*BOX), residual_steps=60
    ),
    "give a policy whose model is that of fit_residual": lambda: Controller(
        None, ActionFlowPolicy(MODEL, Bounded(*BOX), residual_steps=60)
    ),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_done_is_refused(words):
    with pytest.raises(ConfigurationError, match=words):
        REFUSED[words]()
