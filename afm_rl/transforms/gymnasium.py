"""The correction around gymnasium's environments, for whatever policy acts in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from torch import Tensor

from afm_rl.correction import Corrector
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.learning.watching import Watching
from afm_rl.transforms.correction_loop import CorrectionLoop, Model, Observe, State, as_numbers


class ActionFlowWrapper(gymnasium.Wrapper, RecordConstructorArgs):
    r"""Corrects the actions of whatever policy acts in a gymnasium environment.

    The policy's action is the planned one. While the model explains what happens, it is executed
    as it is, brought into the action space; when it does not, the corrector's answer is. Seeds,
    rewards, ends and observations are the environment's own.

    ``info["afm"]`` has, after each step, ``planned``, ``executed`` and ``predicted`` ``(A,)``, the
    last being the effect that the executed action is expected to have; ``corrects``, whether the
    planned action was replaced by the corrector's; the ``innovation``, in standard deviations of
    the model; the ``noise`` ``(A,)`` of the effects that was learnt; and the ``delay``, in how many
    steps the next action will act, known and found: who follows a clock looks as far ahead. With
    ``enabled=False`` it is 0. :attr:`diagnosis` says in words what the actuators seem to do.

    What the model takes for the state is, with ``"mujoco"`` or a
    :class:`~afm_rl.dynamics.MuJoCoDynamics`, the whole state of the environment's simulation, else
    the observation; ``state`` gives another.

    Args:
        env: with a vector of real numbers between finite bounds as action.
        model: ``"mujoco"``, the environment's own model as it is now, with its frame skip; a
            step function ``step(state, action) -> next_state`` in torch, batched; any
            :class:`~afm_rl.dynamics.DynamicsModel`; or ``"learn"``, which watches healthy steps and
            fits an ensemble between two episodes, see
            :class:`~afm_rl.learning.watching.Watching`, of which one with other settings can be
            given. Then ``info["afm"]["learned"]`` says whether there is a model yet, and
            :attr:`watching` how many steps were watched and how good it is.
        state: ``state(env, observation)`` returns the state ``(S,)`` that the model knows.
        corrector: the correction, owned; None: the universal
            :class:`~afm_rl.correction.ActionFlow` for the action space.
        enabled: False to watch only.
        late: what the policy is shown while commands act late: ``"predict"``, the observation in
            the state in which its next command will act; ``"leave"``, what was measured. That is in
            ``info["afm"]["observation"]`` in any case. Rewards and ends stay the environment's own.
        observe: ``observe(states)`` returns what is observed in states ``(N, S)``, arrays both;
            None: the states, if they are what is observed at the first reset, or what a gymnasium
            task with MuJoCo observes in them.
        delay: steps from a command to its effect that are known, one number or one per actuator:
            used from the first step on. What comes on top of it is found out.
        belief: have ``info["afm"]["belief"]``, too: how probable ``(A,)`` each cause is, by name,
            such as ``"nothing has changed"`` or ``"2 steps late"``.
        keep_memory_on_reset: go on with what was learnt in the episodes before, as where a fault
            outlasts them; else each episode begins with an empty memory.

    Raises:
        ConfigurationError: for spaces or a model that cannot be used, or do not fit each other;
            at a step, for actions or states that are not real numbers of the right shape.

    >>> env = ActionFlowWrapper(gymnasium.make("Pendulum-v1"), "learn")
    >>> env.reset(seed=0)[1]["afm"]["learned"]
    False
    >>> _, _, _, _, info = env.step(np.zeros(1, dtype=np.float32))
    >>> info["afm"]["corrects"], env.watching.count
    (False, 1)
    """

    def __init__(
        self,
        env: gymnasium.Env,
        model: Model = "mujoco",
        state: State | None = None,
        corrector: Corrector | None = None,
        enabled: bool = True,
        late: str = "predict",
        observe: Observe | None = None,
        delay: int | Sequence[int] | None = None,
        belief: bool = False,
        keep_memory_on_reset: bool = False,
    ) -> None:
        given: Any = {"model": model, "state": state, "corrector": corrector, "enabled": enabled}
        given |= {"late": late, "observe": observe, "delay": delay, "belief": belief}
        given |= {"keep_memory_on_reset": keep_memory_on_reset}
        RecordConstructorArgs.__init__(self, **given)
        gymnasium.Wrapper.__init__(self, env)
        inner: Any = env.unwrapped
        spaces = env.observation_space, env.action_space
        self._loop = CorrectionLoop(*spaces, source=env, **given)
        simulated = isinstance(self._loop.model, MuJoCoDynamics)
        if simulated and hasattr(inner, "data") and env.action_space != inner.action_space:
            raise ConfigurationError(
                f"ActionFlowWrapper: actions of {env} are others than those of its simulation; "
                "put the wrapper inside of those that change actions"
            )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode, with an empty memory or what was learnt."""
        observation, info = self.env.reset(seed=seed, options=options)
        measured = np.asarray(observation)[None]
        self._loop.begin(self._state(observation), seed=seed, observations=measured)
        shown = self._loop.at_arrival(measured)[0]
        return shown, {**info, "afm": self._told(observation)}

    def step(self, action: Any):
        """Execute the corrected action."""
        planned = as_numbers("action", action, self.action_space.shape)
        executed = self._loop.act(planned[None])[0]
        observation, reward, terminated, truncated, info = self.env.step(executed)
        self._loop.observe(self._state(observation))
        over = np.array([terminated or truncated])
        shown = self._loop.at_arrival(np.asarray(observation)[None], over)[0]
        info = {**info, "afm": self._told(observation)}
        return shown, reward, terminated, truncated, info

    @property
    def watching(self) -> Watching | None:
        """What has been learned, with ``model="learn"``."""
        return self._loop.watching

    @property
    def diagnosis(self) -> str:
        """What the actuators seem to do, in words; takes some milliseconds."""
        return self._loop.diagnosis(0)

    def _state(self, observation: Any) -> Tensor:
        state = self._loop.state(self.env, observation)
        return as_numbers("observation", state, self._loop.state_shape)[None]

    def _told(self, observation: Any) -> dict[str, Any]:
        return {**_first(self._loop.told), "observation": observation}


class ActionFlowVectorWrapper(VectorWrapper, RecordConstructorArgs):
    """Corrects the actions of a policy in a vector of gymnasium environments.

    As :class:`ActionFlowWrapper`, with arrays ``(N, ...)``, each environment with a memory of its
    own that an automatic reset empties, in whichever mode. ``state(env, observations)`` returns
    ``(N, S)``. ``infos["_afm"]`` ``(N,)`` says in which environments a step was made.

    Raises:
        ConfigurationError: as :class:`ActionFlowWrapper`; and if the vector does not say in its
            metadata when it resets environments that ended.

    >>> envs = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync")
    >>> envs = ActionFlowVectorWrapper(envs, "learn")
    >>> envs.reset(seed=0)[1]["afm"]["learned"].tolist()
    [False, False]
    """

    def __init__(
        self,
        env: VectorEnv,
        model: Model = "mujoco",
        state: State | None = None,
        corrector: Corrector | None = None,
        enabled: bool = True,
        late: str = "predict",
        observe: Observe | None = None,
        delay: int | Sequence[int] | None = None,
        belief: bool = False,
        keep_memory_on_reset: bool = False,
    ) -> None:
        given: Any = {"model": model, "state": state, "corrector": corrector, "enabled": enabled}
        given |= {"late": late, "observe": observe, "delay": delay, "belief": belief}
        given |= {"keep_memory_on_reset": keep_memory_on_reset}
        RecordConstructorArgs.__init__(self, **given)
        VectorWrapper.__init__(self, env)
        spaces = env.single_observation_space, env.single_action_space
        self._loop = CorrectionLoop(*spaces, source=env, **given)
        self._mode = autoreset_mode_of(env)
        self._over = np.zeros(env.num_envs, dtype=bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        """Begin episodes, only those in ``options["reset_mask"]`` if it is given."""
        rows = (options or {}).get("reset_mask")
        rows = np.ones(self.env.num_envs, dtype=bool) if rows is None else rows.copy()
        observations, infos = self.env.reset(seed=seed, options=options)
        first = seed[0] if isinstance(seed, list | tuple) else seed
        self._loop.begin(self._states(observations), rows, first, observations)
        self._over &= ~rows
        shown = self._loop.at_arrival(observations)
        return shown, {**infos, "afm": self._told(observations), "_afm": rows}

    def step(self, actions: Any):
        """Execute the corrected actions."""
        executed = self._loop.act(as_numbers("actions", actions, self.action_space.shape))
        observations, rewards, terminated, truncated, infos = self.env.step(executed)
        made, over = ~self._over, np.asarray(terminated) | np.asarray(truncated)
        same = self._mode is AutoresetMode.SAME_STEP
        self._loop.observe(self._states(observations), over if same else self._over)
        self._over = over & (self._mode is AutoresetMode.NEXT_STEP)
        shown = self._loop.at_arrival(observations, None if same else over)
        infos = {**infos, "afm": self._told(observations), "_afm": made}
        return shown, rewards, terminated, truncated, infos

    @property
    def watching(self) -> Watching | None:
        """What has been learned, with ``model="learn"``."""
        return self._loop.watching

    @property
    def diagnosis(self) -> list[str]:
        """What the actuators of each environment seem to do, in words."""
        return [self._loop.diagnosis(row) for row in range(self.num_envs)]

    def _told(self, observations: Any) -> dict[str, Any]:
        return {**self._loop.told, "observation": observations}

    def _states(self, observations: Any) -> Tensor:
        states, shape = self._loop.state(self.env, observations), self._loop.state_shape
        return as_numbers("observations", states, shape and (self.num_envs, *shape))


def _first(told: Any) -> Any:
    """Return what is told of the first environment."""
    if isinstance(told, dict):
        return {name: _first(value) for name, value in told.items()}
    return told[0].item() if isinstance(told[0], np.generic) else told[0]


def autoreset_mode_of(env: VectorEnv) -> AutoresetMode:
    """Return when a vector resets environments that ended, as its metadata say.

    Raises:
        ConfigurationError: if they do not say it: actions would be those of other episodes.

    >>> autoreset_mode_of(gymnasium.make_vec("Pendulum-v1", vectorization_mode="sync"))
    <AutoresetMode.NEXT_STEP: 'NextStep'>
    """
    given = (env.metadata or {}).get("autoreset_mode")
    text = str(given).rpartition(".")[-1].replace("_", "").lower()
    for mode in AutoresetMode:
        if text == mode.value.lower():
            return mode
    raise ConfigurationError(
        f"ActionFlowVectorWrapper: {env}: metadata['autoreset_mode']={given!r}: expected one of "
        f"{', '.join(map(str, AutoresetMode))}; set it to what the vector does"
    )
