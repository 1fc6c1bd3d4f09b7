"""The correction around vectors of Stable-Baselines3, for whatever policy acts in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from afm_rl.errors import ConfigurationError, refusing
from afm_rl.transforms.gymnasium import ActionFlowVectorWrapper, Model, row_of

with refusing("ActionFlowVecEnv: needs a package: pip install 'afm-rl[sb3]'"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize


class AsVectorEnv(VectorEnv):
    """A vector of Stable-Baselines3, as gymnasium has them: episodes begin in the last one's step.

    The ``infos`` of a step are ``{"sb3": ...}``, a list of those of each environment.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, venv: VecEnv) -> None:
        self.venv, self.num_envs = venv, venv.num_envs
        self.single_observation_space = venv.observation_space
        self.single_action_space = venv.action_space
        self.observation_space = batch_space(venv.observation_space, venv.num_envs)
        self.action_space = batch_space(venv.action_space, venv.num_envs)
        self.get_attr, self.call = venv.get_attr, venv.env_method
        self.envs = getattr(venv.unwrapped, "envs", None)  # None: in processes of their own
        self.env_fns = [lambda: gymnasium.make(self.get_attr("spec")[0])]  # as the first was made

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        """Begin all episodes; seeds are given by ``VecEnv.seed``."""
        return self.venv.reset(), {}

    def step(self, actions: Any):
        """Let all environments act."""
        observations, rewards, over, infos = self.venv.step(actions)
        return observations, rewards, over, np.zeros_like(over), {"sb3": infos}


class ActionFlowVecEnv(VecEnvWrapper):
    """Corrects the actions of a policy in a vector of Stable-Baselines3.

    It is an :class:`~afm_rl.ActionFlowVectorWrapper` inside of it: ``infos[k]["afm"]`` and
    :attr:`diagnosis` are what they are there. Put it next to the environments, ``VecNormalize`` and
    others that change observations around it. An observation at the end of an episode,
    ``infos[k]["terminal_observation"]``, is what was measured.

    Args:
        venv: with a vector of real numbers between finite bounds as action.
        model: as in :class:`~afm_rl.ActionFlowWrapper`.
        settings: its other arguments; ``state(envs, observations)`` returns the states ``(N, S)``.

    Raises:
        ConfigurationError: as there; if stable_baselines3 is not installed; or for a
            ``VecNormalize`` inside of it.

    >>> from stable_baselines3.common.vec_env import DummyVecEnv
    >>> venv = ActionFlowVecEnv(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), "learn")
    >>> _ = venv.reset()
    >>> _, _, _, infos = venv.step(np.zeros((1, 1), dtype=np.float32))
    >>> infos[0]["afm"]["corrected"]
    False
    """

    def __init__(self, venv: VecEnv, model: Model = "mujoco", **settings: Any) -> None:
        if unwrap_vec_normalize(venv) is not None:
            raise ConfigurationError(
                f"ActionFlowVecEnv: venv={venv}: its model knows no normalised observations; put "
                "VecNormalize around ActionFlowVecEnv"
            )
        super().__init__(venv)
        self.corrected = ActionFlowVectorWrapper(AsVectorEnv(venv), model, **settings)

    def reset(self) -> np.ndarray:
        """Begin all episodes, with an empty memory or what was learnt."""
        return self.corrected.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the planned actions."""
        self.planned = actions

    def step_wait(self) -> Any:
        """Execute the corrected actions."""
        observations, rewards, over, _, step = self.corrected.step(self.planned)
        infos = [info | {"afm": row_of(step["afm"], k)} for k, info in enumerate(step["sb3"])]
        return observations, rewards, over, infos

    @property
    def diagnosis(self) -> Sequence[str]:
        """What the actuators of each environment seem to do, in words."""
        return self.corrected.diagnosis
