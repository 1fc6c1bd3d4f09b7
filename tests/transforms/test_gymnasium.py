"""The wrapper corrects, and an environment stays what it was."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from puck import Puck, play, push

from afm_rl import ActionFlowWrapper
from afm_rl.errors import ConfigurationError
from afm_rl.transforms.collect_then_fit import CollectThenFit

SMALL = {"transitions": 800, "model": {"hidden": [24], "members": 2}, "fit": {"epochs": 60}}


MODELS = {"step": push, "learn": CollectThenFit(**SMALL), "mujoco": "mujoco"}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_gymnasiums_own_check_passes(model):
    if model == "mujoco":
        pytest.importorskip("mujoco")
        env = gymnasium.make("InvertedPendulum-v5").unwrapped
    else:
        env = Puck()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(ActionFlowWrapper(env, model), skip_render_check=True)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_healthy_steps_are_those_of_the_environment(dtype):
    plain, wrapped = play(Puck(dtype), 30), play(ActionFlowWrapper(Puck(dtype), push), 30)
    for (seen, *rest, info), (other, *others, told) in zip(plain, wrapped, strict=True):
        assert seen.dtype == other.dtype == dtype
        np.testing.assert_array_equal(seen, other)
        assert rest == others and told["mine"] == info["mine"]
        assert not told["afm"]["corrected"] and told["afm"]["innovation"] < 1
        assert "belief" not in told["afm"]
        assert (0 < told["afm"]["noise"]).all() and (told["afm"]["noise"] <= 0.05).all()


def test_reversed_actuators_do_what_was_planned():
    env = ActionFlowWrapper(Puck(gain=-1.0), push, belief=True)
    assert env.diagnosis == "nothing seen yet"
    unaware = env.reset(seed=0)[1]["afm"]["belief"]["no fault"]
    assert (unaware > 0.7).all()
    told = [info["afm"] for *_, info in play(env, 30)]
    assert all(each["corrected"] for each in told[3:])
    for each in told[8:]:
        np.testing.assert_allclose(each["executed_action"], -each["planned_action"], atol=0.1)
        np.testing.assert_allclose(each["predicted_effect"], each["planned_action"], atol=0.1)
        assert (each["belief"]["a recent change"] > 0.9).all()
    assert "actuator 0: reversed" in env.diagnosis


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("plan", [5.0, 1e30, 1e300])
def test_plans_beyond_the_space_are_brought_into_it(plan, dtype):
    for gain in (1.0, -1.0):
        env = ActionFlowWrapper(Puck(dtype, gain), push)
        play(env, 10)
        for sign in (1.0, -1.0):
            told = env.step(np.array([sign * plan, 0.3]))[-1]["afm"]
            np.testing.assert_allclose(
                told["executed_action"], [sign * gain, gain * 0.3], atol=0.02
            )
    held = env.step(np.array([np.inf, 0.3]))[-1]["afm"]["executed_action"]
    np.testing.assert_allclose(held, told["executed_action"], atol=1e-3)  # the plan before


def test_steps_need_a_reset_and_go_on_after_what_is_no_action():
    env = ActionFlowWrapper(Puck(), push)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2))
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="'action': NoneType"):
        env.step(None)
    env.step(np.zeros(2))


@pytest.mark.check
@pytest.mark.filterwarnings("ignore")
def test_models_are_learned_from_healthy_steps():
    torch.manual_seed(0)
    env = ActionFlowWrapper(Puck(ends=50), CollectThenFit(**SMALL))
    told = play(env, 50, hold=1.0)[-1][-1]["afm"]
    assert env.collection.count == 50 and not told["learned"] and env.collection.report is None
    assert "tensor" not in repr(env.collection)  # of thousands of transitions
    assert (
        told["planned_action"] != told["executed_action"]
    ).any()  # noise, so that actions tell something
    for episode in range(16):
        play(env, 50, episode, hold=1.0)
    _, info = env.reset()
    assert info["afm"]["learned"] and env.collection.report.error < 0.2
    alarms = [info["afm"]["corrected"] for *_, info in play(env, 50, 9, hold=1.0)]
    env.unwrapped.gain = -1.0
    told = [info["afm"] for *_, info in play(env, 50, 9, hold=1.0)]
    assert np.mean(alarms) < 0.2 and told[-1]["corrected"]
    missed = [abs(each["executed_action"] + each["planned_action"]).mean() for each in told[10:]]
    assert np.mean(missed) < 0.2


@pytest.mark.filterwarnings("ignore")
def test_models_that_are_not_good_enough_are_not_used():
    settings = {**SMALL, "error": 1e-6, "fit": {"epochs": 1}, "transitions": 260}
    collection = CollectThenFit(**settings)
    env = ActionFlowWrapper(Puck(), collection)
    play(env, 270)
    _, info = env.reset()
    assert not info["afm"]["learned"] and env.collection.report.error > 1e-6
    assert env.collection.needed == 540
    assert collection.count == 0  # that of the user is a description


WRONG = [
    (lambda state: {"over": torch.zeros(1)}, r"\[\] are unknown, and \['memory.actions'"),
    (lambda state: state | {"memory": torch.zeros(9)}, "version 0.3, whose memory cannot"),
    (lambda state: state | {"memory.noise": torch.zeros(1, 3)}, r"shape \(1, 3\): expected"),
    (lambda state: state | {"memory.noise": torch.tensor([torch.nan])}, "expected finite numbers"),
]


@pytest.mark.parametrize(("changed", "words"), WRONG)
def test_a_state_of_others_is_checked_before_anything_changes(changed, words):
    env = ActionFlowWrapper(gymnasium.make("Pendulum-v1"), lambda s, a: s)
    env.reset(seed=0)
    before = env.state_dict()
    state, memory = changed(before), env.memory
    with pytest.raises(ConfigurationError, match=words):
        env.load_state_dict(state)
    assert env.memory is memory
    env.load_state_dict(before)
