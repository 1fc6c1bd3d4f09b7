"""The wrapper corrects, and an environment stays what it was."""

import copy
import math
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

import afm_rl
from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.learning.watching import Watching
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform
from afm_rl.transforms.correction_loop import CorrectionLoop

SMALL = {
    "transitions": 800,
    "false_alarms": 0.1,
    "model": {"hidden": [24], "members": 2},
    "fit": {"epochs": 60},
}


def push(state, action):
    return torch.cat([state[..., :2] + 0.1 * state[..., 2:], state[..., 2:] + 0.1 * action], -1)


class Puck(gymnasium.Env):
    """Two forces push a puck; ``gain`` is hidden from everybody."""

    def __init__(self, dtype=np.float64, gain=1.0, ends=None, nested=False):
        self.dtype, self.gain, self.ends, self.nested = dtype, gain, ends, nested
        vector = Box(-np.inf, np.inf, (4,), dtype)
        self.observation_space = Dict({"puck": vector}) if nested else vector
        self.action_space = Box(-1, 1, (2,), dtype)

    def _seen(self):
        seen = self.state.astype(self.dtype)
        return {"puck": seen} if self.nested else seen

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.normal(size=4), 0
        return self._seen(), {"mine": 1}

    def step(self, action):
        assert self.action_space.contains(action)
        force = torch.from_numpy(self.gain * action).double()
        self.state = push(torch.from_numpy(self.state), force).numpy()
        self.steps += 1
        return self._seen(), float(action.sum()), self.steps == self.ends, False, {"mine": 2}


def play(env, steps, seed=0, hold=0.0):
    """Act at random; ``hold`` keeps a puck near its place."""
    seen, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    told = []
    for _ in range(steps):
        planned = env.action_space.sample() - hold * (seen[:2] + seen[2:] if hold else 0.0)
        told.append(env.step(planned.clip(-1, 1)))
        seen = told[-1][0]
    return told


def envs_of(mode, gains, ends=5):
    makers = [lambda gain=gain: Puck(gain=gain, ends=ends) for gain in gains]
    return SyncVectorEnv(makers, autoreset_mode=mode)


def test_the_package_offers_it():
    assert afm_rl.ActionFlowWrapper is ActionFlowWrapper
    with pytest.raises(AttributeError, match="Nothing"):
        afm_rl.Nothing  # noqa: B018


@pytest.mark.parametrize("model", [push, Watching(**SMALL), "mujoco"], ids=["step", "learn", "mj"])
def test_gymnasiums_own_check_passes(model):
    if model == "mujoco":
        pytest.importorskip("mujoco")
        env = gymnasium.make("InvertedPendulum-v5").unwrapped
    else:
        env = Puck()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
        check_env(ActionFlowWrapper(env, model), skip_render_check=True)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_healthy_steps_are_those_of_the_environment(dtype):
    plain, wrapped = play(Puck(dtype), 30), play(ActionFlowWrapper(Puck(dtype), push), 30)
    for (seen, *rest, info), (other, *others, told) in zip(plain, wrapped, strict=True):
        assert seen.dtype == other.dtype == dtype
        np.testing.assert_array_equal(seen, other)
        assert rest == others and told["mine"] == info["mine"]
        assert not told["afm"]["corrects"] and told["afm"]["innovation"] < 1
        assert told["afm"]["diagnosis"] == "as the model expects"


def test_reversed_actuators_do_what_was_planned():
    steps = play(ActionFlowWrapper(Puck(gain=-1.0), push), 30)
    told = [info["afm"] for *_, info in steps]
    assert all(each["corrects"] for each in told[3:])
    for each in told[8:]:
        np.testing.assert_allclose(each["executed"], -each["planned"], atol=0.1)
        np.testing.assert_allclose(each["predicted"], each["planned"], atol=0.1)
    assert "actuator 0: reversed" in told[-1]["diagnosis"]


def test_a_diagnosis_is_made_when_it_is_asked_for(monkeypatch):
    asked = []

    def explain(*args):
        asked.append(args)
        return "reversed"

    monkeypatch.setattr("afm_rl.transforms.correction_loop.explain", explain)
    *_, last = [info["afm"] for *_, info in play(ActionFlowWrapper(Puck(gain=-1.0), push), 20)]
    kept = copy.deepcopy(last)
    assert not asked and "diagnosis" not in kept
    assert kept["diagnosis"] == kept["diagnosis"] == "reversed" and len(asked) == 1
    assert pickle.loads(pickle.dumps(last))["diagnosis"] == "reversed"  # as between processes
    with pytest.raises(KeyError):
        last["something"]


def test_watching_only_corrects_nothing():
    for *_, info in play(ActionFlowWrapper(Puck(gain=-1.0), push, enabled=False), 20):
        np.testing.assert_array_equal(info["afm"]["planned"], info["afm"]["executed"])
        assert not info["afm"]["corrects"]


def test_actions_are_those_of_the_transform():
    def healthy(state, action):
        return state + 0.1 * action

    low, high = -torch.ones(2), torch.ones(2)
    cost = KnownReward(lambda state, action, ahead: -ahead.square().sum(-1))
    world = PlanningEnv(KnownDynamics(lambda s, a: healthy(s, -a), Manifold(2), 2), cost, low, high)
    env = TransformedEnv(world, ActionFlowTransform(KnownDynamics(healthy, Manifold(2), 2)))
    loop = CorrectionLoop(Box(-9, 9, (2,)), Box(-1, 1, (2,)), healthy)
    data = env.reset(TensorDict({"observation": torch.tensor([0.3, -0.2])}))
    loop.begin(data["observation"][None])
    for step in range(15):
        planned = torch.tensor([0.6, 0.4]) * math.cos(step)
        data, after = env.step_and_maybe_reset(data.set("action", planned))
        executed = loop.act(planned[None].numpy())
        loop.observe(data["next", "observation"][None])
        np.testing.assert_array_equal(executed[0], data["next", "afm", "executed_action"])
        data = after
    assert loop.told["corrects"].all()


def test_states_of_ones_own():
    def state(env, observation):
        return env.unwrapped.state

    steps = play(ActionFlowWrapper(Puck(gain=-1.0, nested=True), push, state), 20)
    assert steps[-1][-1]["afm"]["corrects"] and "puck" in steps[-1][0]


def test_an_episode_begins_with_an_empty_memory():
    env = ActionFlowWrapper(Puck(gain=-1.0), push)
    assert play(env, 10)[-1][-1]["afm"]["corrects"]
    _, info = env.reset()
    assert not info["afm"]["corrects"] and info["afm"]["diagnosis"] == "as the model expects"
    assert not env.step(np.zeros(2))[-1]["afm"]["corrects"]


def test_actions_beyond_the_space_are_brought_into_it():
    env = ActionFlowWrapper(Puck(), push)
    env.reset(seed=0)
    *_, info = env.step(np.array([5.0, -5.0]))
    np.testing.assert_array_equal(info["afm"]["executed"], [1.0, -1.0])


def test_steps_need_a_reset():
    with pytest.raises(ResetNeeded):
        ActionFlowWrapper(Puck(), push).step(np.zeros(2))


def test_truncation_passes():
    env = gymnasium.wrappers.TimeLimit(Puck(), 5)
    ends = [step[2:4] for step in play(ActionFlowWrapper(env, push), 5)]
    assert ends[-1] == (False, True) and ends[-2] == (False, False)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vectors_have_a_memory_each(mode):
    envs = ActionFlowVectorWrapper(envs_of(mode, [1.0, -1.0], ends=6), push)
    plain = envs_of(mode, [1.0], ends=6)
    observations, infos = envs.reset(seed=0)
    plain.reset(seed=0)
    assert infos["_afm"].all() and not infos["afm"]["corrects"].any()
    rng, begun = np.random.default_rng(0), 0
    for _ in range(20):
        actions = rng.uniform(-1, 1, (2, 2))
        observations, _, terminated, _, infos = envs.step(actions)
        seen, *_ = plain.step(actions[:1])
        np.testing.assert_array_equal(observations[0], seen[0])
        begun = 0 if not infos["_afm"].all() else begun + 1
        told = infos["afm"]
        assert not told["corrects"][0]  # never alarmed by a reset
        assert bool(told["corrects"][1]) == (begun > 1) or not infos["_afm"][1]
        if mode is AutoresetMode.SAME_STEP and terminated.any():
            begun = 0
        if mode is AutoresetMode.DISABLED and terminated.any():
            begun = 0
            options = [{"reset_mask": terminated[rows].copy()} for rows in ([0, 1], [0])]
            envs.reset(options=options[0])
            plain.reset(options=options[1])


def test_mujoco_in_a_vector_of_one_process_or_of_several():
    pytest.importorskip("mujoco")
    ran, rng = [], np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (55, 3, 2)).astype(np.float32)  # 50 steps are an episode
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        made = [lambda: gymnasium.make("Reacher-v5")] * 2
        made.append(lambda: Reversed(gymnasium.make("Reacher-v5")))
        envs = ActionFlowVectorWrapper(kind(made), "mujoco")
        envs.reset(seed=0)
        ran.append([envs.step(each) for each in actions])
        envs.close()
    for (seen, *_, infos), (other, *_, told) in zip(*ran, strict=True):
        np.testing.assert_array_equal(seen, other)
        np.testing.assert_array_equal(infos["afm"]["executed"], told["afm"]["executed"])
        assert not infos["afm"]["corrects"][:2].any()
    assert ran[0][40][-1]["afm"]["corrects"][2] and infos["afm"]["executed"].shape == (3, 2)
    assert "a_0: reversed" in ran[1][40][-1]["afm"]["diagnosis"][2]


@pytest.mark.filterwarnings("ignore")
def test_models_are_learned_from_healthy_steps():
    torch.manual_seed(0)
    env = ActionFlowWrapper(Puck(ends=50), Watching(**SMALL))
    told = play(env, 50, hold=1.0)[-1][-1]["afm"]
    assert env.watching.count == 50 and not told["learned"] and env.watching.report is None
    assert "tensor" not in repr(env.watching)  # of thousands of transitions
    assert (told["planned"] != told["executed"]).any()  # noise, so that actions tell something
    for episode in range(16):
        play(env, 50, episode, hold=1.0)
    _, info = env.reset()
    assert info["afm"]["learned"] and env.watching.report.error < 0.2
    alarms = [info["afm"]["corrects"] for *_, info in play(env, 50, 9, hold=1.0)]
    env.unwrapped.gain = -1.0
    told = [info["afm"] for *_, info in play(env, 50, 9, hold=1.0)]
    assert np.mean(alarms) < 0.2 and told[-1]["corrects"]
    missed = [abs(each["executed"] + each["planned"]).mean() for each in told[10:]]
    assert np.mean(missed) < 0.2


@pytest.mark.filterwarnings("ignore")
def test_models_that_are_not_good_enough_are_not_used():
    watching = Watching(
        **{**SMALL, "error": 1e-6, "fit": {"epochs": 1}, "false_alarms": 0.5, "transitions": 260}
    )
    env = ActionFlowWrapper(Puck(), watching)
    play(env, 270)
    _, info = env.reset()
    assert not info["afm"]["learned"] and env.watching.report.error > 1e-6
    assert env.watching.needed == 540 and watching.count == 0  # that of the user is a description


class Reversed(gymnasium.ActionWrapper):
    def action(self, action):
        return -action


def test_too_few_steps_for_a_gate_are_refused():
    with pytest.raises(ConfigurationError, match="transitions=500: expected at least 8000"):
        Watching(transitions=500)


def test_what_cannot_be_used_is_refused():
    def refused(match, env, *args):
        with pytest.raises(ConfigurationError, match=match):
            ActionFlowWrapper(env, *args).reset()

    discrete = Puck()
    discrete.action_space = Discrete(2)
    endless = Puck()
    endless.action_space = Box(-np.inf, np.inf, (2,))
    refused("Discrete", discrete, push)
    refused("finite bounds", endless, push)
    refused(r"Dict.*state=lambda", Puck(nested=True), push)
    refused("has no MuJoCo model", Puck())
    refused("'mujoco', 'learn'", Puck(), "musculoskeletal")
    refused("a step function", Puck(), 3)
    refused(r"state has \(4,\) numbers, that of the model 3", Puck(), Dubins())
    wrong = KnownDynamics(push, Manifold(4), 3)
    refused("3 finite bounds", Puck(), wrong)
    pytest.importorskip("mujoco")
    rescaled = gymnasium.wrappers.RescaleAction(gymnasium.make("InvertedPendulum-v5"), -1, 1)
    refused("inside of those that change actions", rescaled)
