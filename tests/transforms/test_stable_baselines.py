"""The correction in vectors of Stable-Baselines3 is that of gymnasium's vectors."""

import sys

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from puck import Puck, push

import afm_rl
from afm_rl import ActionFlowVectorWrapper
from afm_rl.errors import ConfigurationError

pytestmark = pytest.mark.check
vectors = pytest.importorskip("stable_baselines3.common.vec_env")
MAKERS = [lambda: Puck(gain=-1.0, ends=30), lambda: Puck(ends=40)]
PLANS = np.random.default_rng(0).uniform(-1, 1, (60, 2, 2))


def corrected(venv, **settings):
    from afm_rl import ActionFlowVecEnv

    return ActionFlowVecEnv(venv, push, **settings)


def test_each_environment_gets_the_actions_of_a_vector_of_gymnasium():
    expected = SyncVectorEnv(MAKERS, autoreset_mode=AutoresetMode.SAME_STEP)
    expected = ActionFlowVectorWrapper(expected, push)
    envs = vectors.VecNormalize(corrected(vectors.DummyVecEnv(MAKERS)), norm_obs=False)
    assert len(envs.reset()) == len(expected.reset(seed=0)[0])
    ended = 0
    for plans in PLANS:
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
    np.testing.assert_allclose(infos[0]["afm"]["executed_action"], -PLANS[-1, 0], atol=0.1)


def test_normalised_observations_are_refused_inside():
    venv = vectors.VecNormalize(vectors.DummyVecEnv(MAKERS))
    with pytest.raises(ConfigurationError, match="put VecNormalize around ActionFlowVecEnv"):
        corrected(venv)


def test_who_lacks_the_package_is_told_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "afm_rl.transforms.stable_baselines", raising=False)
    monkeypatch.delitem(vars(afm_rl), "ActionFlowVecEnv", raising=False)  # kept once it is imported
    for name in [name for name in sys.modules if name.startswith("stable_baselines3")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigurationError, match=r"pip install 'afm-rl\[sb3\]'"):
        corrected(None)
