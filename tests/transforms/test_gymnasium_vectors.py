"""Vectors of environments, in one process, in several, and wrappers in several threads."""

import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from puck import Puck, alone, play, push

import afm_rl
from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, FaultWrapper
from afm_rl.errors import ConfigurationError
from afm_rl.transforms import collect_then_fit
from afm_rl.transforms.gymnasium import autoreset_mode_of

GAINS, ENDS = (1.0, -1.0, 0.5), (6, 9, 7)


def makers():
    return [
        lambda gain=gain, end=end: Puck(gain=gain, ends=end)
        for gain, end in zip(GAINS, ENDS, strict=True)
    ]


def executed_alone(plans, mode):
    """Return what a wrapper of its own executes for each environment, and at which steps."""
    executed, made = np.zeros((len(plans), 3, 2)), np.zeros((len(plans), 3), dtype=bool)
    for row, make in enumerate(makers()):
        for step, info in alone(ActionFlowWrapper(make(), push), plans[:, row], mode, seed=row):
            executed[step, row], made[step, row] = info["afm"]["executed_action"], True
    return executed, made


def processes(makers, **settings):
    # Forked, which takes no time; torchrl has others spawned, and each would import torch.
    return AsyncVectorEnv(makers, context="fork", **settings)


@pytest.mark.check
@pytest.mark.parametrize(
    ("kind", "mode"),
    [*((SyncVectorEnv, mode) for mode in AutoresetMode), (processes, AutoresetMode.SAME_STEP)],
)
def test_each_environment_gets_the_actions_of_a_wrapper_of_its_own(kind, mode):
    plans = np.random.default_rng(0).uniform(-1, 1, (18, 3, 2))
    envs = ActionFlowVectorWrapper(kind(makers(), autoreset_mode=mode), push)
    envs.reset(seed=[0, 1, 2])
    expected, made = executed_alone(plans, mode)
    for step, plan in enumerate(plans):
        _, _, over, _, infos = envs.step(plan)
        np.testing.assert_array_equal(infos["_afm"], made[step])
        found = infos["afm"]["executed_action"][made[step]]
        np.testing.assert_allclose(found, expected[step, made[step]], atol=1e-3)
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over.copy()})
    assert (np.abs(expected[:, 1] + plans[:, 1]).max(-1) < 0.1).sum() > 7  # it was corrected
    envs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_what_is_learned_from_are_steps_within_episodes(mode, monkeypatch):
    learned_from, count = [], 0

    def fit(model, data, **settings):
        learned_from.append(data)
        return SimpleNamespace(error=1.0)

    monkeypatch.setattr(collect_then_fit, "fit_ensemble", fit)
    vector = SyncVectorEnv([lambda: Puck(ends=6), lambda: Puck(ends=9)], autoreset_mode=mode)
    envs = ActionFlowVectorWrapper(vector, "learn")
    envs.reset(seed=0)
    for _ in range(20):
        *_, over, _, infos = envs.step(np.zeros((2, 2)))
        lost = over if mode is AutoresetMode.SAME_STEP else False  # nobody sees what they led to
        count += (infos["_afm"] & ~np.asarray(lost)).sum()
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over.copy()})
    envs.collection.learn()
    (data,) = learned_from
    torch.testing.assert_close(
        data["next", "observation"], push(data["observation"], data["action"])
    )
    assert len(data) == envs.collection.count == count


@pytest.mark.check
@pytest.mark.parametrize(
    ("mode", "gain"), [*zip(AutoresetMode, [[-1.0, 1.0], [1.0, 0.5], [-1.0, 1.0]], strict=True)]
)
def test_the_diagnosis_of_an_episode_is_told_at_its_end(mode, gain):
    """Also if the next episode began automatically."""
    makers = [lambda: Puck(gain=gain, ends=30), lambda: Puck(ends=50)]
    envs = ActionFlowVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), push, belief=True)
    envs.reset(seed=0)
    plans = np.random.default_rng(0).uniform(-1, 1, (30, 2, 2))
    *others, last = [envs.step(row)[-1]["afm"] for row in plans]
    assert not any("diagnosis" in told for told in others)
    told, untold = last["diagnosis"]
    first, second = told.splitlines()
    assert untold == "" and envs.diagnosis[0] == told
    assert ("reversed" in first, "50 %" in second) == (gain[0] < 0, gain[1] < 1)


def test_mujoco_in_a_vector_of_one_process_or_of_several():
    pytest.importorskip("mujoco")
    ran, rng = [], np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 2, 2)).astype(np.float32)
    for kind in (SyncVectorEnv, processes):
        makers = [
            lambda fault=fault: FaultWrapper(
                gymnasium.make("Reacher-v5", max_episode_steps=25), fault
            )
            for fault in ("none", "all reversed")
        ]
        envs = ActionFlowVectorWrapper(kind(makers), "mujoco")
        envs.reset(seed=0)
        ran.append([envs.step(each) for each in actions[:25]])
        assert "joint0: reversed" in envs.diagnosis[1]
        ran[-1] += [envs.step(each) for each in actions[25:]]
        envs.close()
    for (seen, *_, infos), (other, *_, told) in zip(*ran, strict=True):
        np.testing.assert_array_equal(seen, other)
        np.testing.assert_array_equal(
            infos["afm"]["executed_action"], told["afm"]["executed_action"]
        )
        assert not infos["afm"]["corrected"][0]
    assert infos["afm"]["corrected"][1] and not ran[0][25][-1]["_afm"].any()


@pytest.mark.parametrize("text", ["SameStep", "same_step", "SAME_STEP", "AutoresetMode.SAME_STEP"])
def test_when_environments_are_reset_may_be_said_in_words(text):
    envs = SyncVectorEnv(makers())
    envs.metadata = {"autoreset_mode": text}
    assert autoreset_mode_of(envs) is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("given", [None, "sometimes", 3])
def test_a_vector_that_does_not_say_when_it_resets_is_refused(given):
    envs = SyncVectorEnv(makers())
    envs.metadata = {} if given is None else {"autoreset_mode": given}
    with pytest.raises(ConfigurationError, match=rf"autoreset_mode'\]={given!r}: expected one of"):
        ActionFlowVectorWrapper(envs, push)


@pytest.mark.check
def test_wrappers_in_threads_execute_what_they_do_in_one():
    def run(gain):
        steps = play(ActionFlowWrapper(Puck(gain=gain), push), 8)
        return np.array([info["afm"]["executed_action"] for *_, info in steps])

    gains = (-1.0, 0.5)
    expected = [*map(run, gains)]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(4):
            np.testing.assert_array_equal([*pool.map(run, gains)], expected)


MAKERS = [lambda: Puck(gain=-1.0, ends=30), lambda: Puck(ends=40)]


@pytest.mark.check
def test_a_vector_of_stable_baselines_gets_the_actions_of_one_of_gymnasium():
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    expected = SyncVectorEnv(MAKERS, autoreset_mode=AutoresetMode.SAME_STEP)
    expected = ActionFlowVectorWrapper(expected, push)
    corrected = afm_rl.ActionFlowVecEnv(vectors.DummyVecEnv(MAKERS), push)
    envs = vectors.VecNormalize(corrected, norm_obs=False)
    assert len(envs.reset()) == len(expected.reset(seed=0)[0])
    ended = 0
    for plans in np.random.default_rng(0).uniform(-1, 1, (60, 2, 2)):
        _, _, over, infos = envs.step(plans)
        _, _, terminated, _, told = expected.step(plans)
        np.testing.assert_array_equal(over, terminated)
        for row, info in enumerate(infos):
            np.testing.assert_allclose(
                info["afm"]["executed_action"], told["afm"]["executed_action"][row], atol=0.05
            )
            assert ("terminal_observation" in info) == over[row]
        ended += over.sum()
    assert ended == 3 and envs.venv.diagnosis == expected.diagnosis
    np.testing.assert_allclose(infos[0]["afm"]["executed_action"], -plans[0], atol=0.1)

    inside = vectors.VecNormalize(vectors.DummyVecEnv(MAKERS))
    with pytest.raises(ConfigurationError, match="put VecNormalize around ActionFlowVecEnv"):
        afm_rl.ActionFlowVecEnv(inside, push)


@pytest.mark.check
def test_who_lacks_the_package_is_told_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "afm_rl.transforms.stable_baselines", raising=False)
    monkeypatch.delitem(vars(afm_rl), "ActionFlowVecEnv", raising=False)  # kept once it is imported
    for name in [name for name in sys.modules if name.startswith("stable_baselines3")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigurationError, match=r"pip install 'afm-rl\[sb3\]'"):
        afm_rl.ActionFlowVecEnv(None, push)
