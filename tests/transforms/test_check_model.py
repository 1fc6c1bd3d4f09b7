"""A model is compared with an environment; and where it seems to be wrong, every shell says so."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import NormalizeObservation
from puck import Puck, play, push
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, check_model
from afm_rl.correction import LeastSquares
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform

LOW, HIGH = -torch.ones(2), torch.ones(2)
MODEL = KnownDynamics(push, Manifold(4), 2)


def test_an_environment_of_gymnasium():
    assert check_model(Puck(ends=7), push, seed=3).right
    found = check_model(Puck(ends=7, gain=-1.0), push, lambda seen: -seen[:2] - seen[2:], steps=80)
    assert found.steps == 80 and found.factor == pytest.approx([-1.0])
    assert found.cause == "acts on -1 times the action (a sign)"
    nested = check_model(Puck(nested=True), push, state=lambda env, seen: seen["puck"])
    assert nested.right and nested.names[0] == "state[0]"


def test_normalised_observations():
    env = NormalizeObservation(Puck(ends=50))
    found = check_model(env, push)
    assert "(normalised observations, units)" in found.cause and found.corrected > 0.99
    assert found.factor == pytest.approx(np.sqrt(env.obs_rms.var + env.epsilon), rel=0.05)
    assert env.update_running_mean


@pytest.mark.parametrize("make", [gymnasium.make, GymEnv])
@pytest.mark.parametrize(("skip", "cause"), [(None, ""), (1, "makes 2 steps of the model in one")])
def test_a_simulator(skip, cause, make, tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    from afm_rl.dynamics import MuJoCoDynamics

    monkeypatch.chdir(tmp_path)  # where MuJoCo would say that a simulation explodes
    env = make("InvertedPendulum-v5")
    inner = getattr(env, "_env", env)
    found = check_model(env, "mujoco" if skip is None else MuJoCoDynamics(inner, skip))
    assert found.right is (not cause) and found.cause.startswith(cause)
    assert found.names == ("q_slider", "q_hinge", "v_slider", "v_hinge")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("batch", [(), (3,)])
def test_an_environment_of_torchrl(batch):
    env = UGVTrack(batch_size=batch)
    assert check_model(env, Dubins(), steps=60).right
    found = check_model(env, lambda s, a: Dubins()(s, a * torch.tensor([1.0, -1.0])), steps=60)
    assert found.cause == "acts on -1 times action[1] (signs, gains or units)"


@pytest.mark.parametrize(
    ("env", "given", "message"),
    [
        (Puck, {"model": "learn"}, "model='learn': there is no model yet"),
        (Puck, {"model": Dubins()}, "the state has"),
        (Puck, {"model": push, "steps": 0}, "steps=0"),
        (Puck, {"model": push, "policy": lambda seen: seen}, "action: shape"),
        (UGVTrack, {}, "has no MuJoCo model"),
        (UGVTrack, {"model": "learn"}, "model='learn': expected 'mujoco', a step function"),
        (UGVTrack, {"model": Dubins(), "state": "pos"}, "state='pos': the environment has no such"),
    ],
)
def test_what_does_not_fit_is_refused(env, given, message):
    with pytest.raises(ConfigurationError, match=message):
        check_model(env(), **given)


def wrapper(gain, corrector=None, enabled=True):
    play(ActionFlowWrapper(Puck(gain=gain), push, corrector=corrector, enabled=enabled), 80)


def vector(gain, **how):
    envs = gymnasium.vector.SyncVectorEnv([lambda: Puck(gain=gain, ends=9)] * 2)
    play(ActionFlowVectorWrapper(envs, push, **how), 80)


def transform(gain, **how):
    reward = KnownReward(lambda state, action, ahead: -ahead.square().sum(-1))
    world = PlanningEnv(
        KnownDynamics(lambda s, a: push(s, gain * a), Manifold(4), 2), reward, LOW, HIGH
    )
    env = TransformedEnv(world, ActionFlowTransform(MODEL, **how))
    env.rollout(
        80, auto_reset=False, tensordict=env.reset(TensorDict({"observation": torch.zeros(4)}))
    )


def policy(gain, **how):
    act = ActionFlowPolicy(MODEL, Bounded(LOW, HIGH, (2,)), **how)
    td = act.make_tensordict_primer()(TensorDict({"observation": torch.zeros(4)}))
    for planned in torch.rand(80, 2, generator=torch.Generator().manual_seed(0)) - 0.5:
        td = act(td.set("action", planned))
        td = step_mdp(td.set(("next", "observation"), push(td["observation"], gain * td["action"])))


@pytest.mark.parametrize("shell", [wrapper, vector, transform, policy])
def test_every_shell_says_once_that_it_corrects_from_the_first_steps_on(shell):
    for gain, how, count in ((0.5, {}, 1), (1.0, {}, 0), (0.5, {"enabled": False}, 0)):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            shell(gain, **how)
        said = [str(w.message) for w in found if "were corrected" in str(w.message)]
        assert len(said) == count
        assert all("(gain 0.5 on all: dt or a unit of the model?)" in text for text in said)


def test_what_is_said_of_the_cause():
    cause = LeastSquares(LOW, HIGH)
    with pytest.warns(UserWarning, match="gain -1 on all: a sign of the model"):
        wrapper(-1.0, cause)
    with pytest.warns(UserWarning, match="gain 1, -0.5: a sign of the model"):
        wrapper(np.array([1.0, -0.5]))
