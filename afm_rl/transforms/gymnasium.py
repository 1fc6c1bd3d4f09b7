"""The correction around gymnasium's environments, for whatever policy acts in them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from torch import Tensor
from torchrl.data import Bounded

from afm_rl.correction import Correction, Corrector
from afm_rl.dynamics import DynamicsModel, KnownDynamics, MuJoCoDynamics, UnknownDynamics
from afm_rl.dynamics.action_map import ActionMap
from afm_rl.dynamics.linear_residual import nominal_of
from afm_rl.dynamics.mujoco_model import host_of
from afm_rl.errors import ConfigurationError, warn
from afm_rl.faults import check_numbers
from afm_rl.options import options
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import delay_compensation as delays
from afm_rl.transforms.loop import CorrectionLoop
from afm_rl.transforms.loop_options import LoopOptions
from afm_rl.transforms.memory import MemoryHolder, check_state
from afm_rl.transforms.simulation import Simulation, check_action_map, states_of

if TYPE_CHECKING:  # imported when it is used
    from afm_rl.transforms.collect_then_fit import CollectThenFit

Model: TypeAlias = "DynamicsModel | Callable[[Tensor, Tensor], Tensor] | CollectThenFit | str"
State = Callable[[Any, Any], Any]
Observe = Callable[[np.ndarray], Any]
REMEMBERED = 150  # steps of each environment, whose words are those of a diagnosis
UNKNOWN = delays.UNKNOWN.format("give observe=, a function from states (N, S) to observations")


class GymnasiumShell(MemoryHolder):
    """The loop for N environments of gymnasium: what :class:`ActionFlowWrapper` says."""

    env: Any

    @options("wrapper")
    def __init__(
        self,
        env: Any,
        model: Model = "mujoco",
        state: State | None = None,
        corrector: Corrector | None = None,
        observe: Observe | None = None,
        action_map: ActionMap | None = None,
        **options: Unpack[LoopOptions],
    ) -> None:
        kind = gymnasium.Env if isinstance(self, gymnasium.Wrapper) else VectorEnv
        fits = isinstance(env, kind)
        if not fits:
            raise ConfigurationError(
                f"{type(self).__name__}: {type(env).__name__}: expected a gymnasium environment "
                "for ActionFlowWrapper, a vector of them for ActionFlowVectorWrapper, a VecEnv of "
                "Stable-Baselines3 for ActionFlowVecEnv, an EnvBase of TorchRL for "
                "ActionFlowTransform"
            )
        check_action_map("wrapper", action_map, model)
        given: Any = {"model": model, "state": state, "corrector": corrector, "observe": observe}
        given["action_map"] = action_map
        RecordConstructorArgs.__init__(self, **given, **options)  # type: ignore[arg-type]
        super().__init__(env)  # type: ignore[call-arg]
        self._loop, self._corrector = CorrectionLoop("wrapper", **options), corrector
        actions = getattr(env, "single_action_space", env.action_space)
        if not isinstance(actions, Box) or len(actions.shape) != 1 or actions.dtype.kind != "f":
            raise ConfigurationError(
                f"ActionFlowWrapper: action_space={actions}: expected a Box of one vector of real "
                "numbers"
            )
        self._actions, self._collection = actions, _collection(model)
        self._model: Any = model
        if isinstance(model, str) and model == "mujoco":
            self._model = _simulation(env, action_map)
            self._model.home = None  # the pose in which the first episode begins
        if self._collection is None and not callable(self._model):
            raise ConfigurationError(
                f"ActionFlowWrapper: model={model!r}: expected 'mujoco', 'learn', a step function "
                "or a DynamicsModel"
            )
        nominal, inner = nominal_of(self._model), host_of(env)
        simulated = isinstance(nominal, MuJoCoDynamics)
        self._own = simulated and (isinstance(model, str) or hasattr(inner, "data"))
        if simulated and hasattr(inner, "data") and env.action_space != inner.action_space:
            raise ConfigurationError(
                f"ActionFlowWrapper: actions of {env} are others than those of its simulation; "
                "put the wrapper inside of those that change actions"
            )
        if state is None and simulated:
            simulation = Simulation(env)
            read = _vector_state if isinstance(env, VectorEnv) else simulation.read
            state = partial(read, nominal)
            if observe is None and simulation.seen:
                observe = partial(_observed_in, simulation)
        self._observed_in = observe  # None: known at the first reset, or not at all
        seen = getattr(env, "single_observation_space", env.observation_space)
        if state is None and not (isinstance(seen, Box) and len(seen.shape) == 1):
            raise ConfigurationError(
                f"ActionFlowWrapper: observation_space={seen}: expected a Box of one vector; say "
                "what the state is by state=lambda env, observation: ..."
            )
        self._state_of: State = _observed if state is None else state
        names: Any = self._model.names[1] if simulated else None
        self._names: list[str] = names or [f"actuator {k}" for k in range(actions.shape[0])]
        one = not isinstance(env, VectorEnv)
        self._mode = AutoresetMode.DISABLED if one else autoreset_mode_of(env)
        count = 1 if one else env.num_envs
        self._over = np.zeros(count, dtype=bool)  # which the next step resets
        self._steps: deque[tuple[np.ndarray, Tensor, Tensor, Tensor]] = deque(maxlen=REMEMBERED)
        self._episodes = np.zeros(count, dtype=int)

    @property
    def collection(self) -> CollectThenFit | None:
        """What is collected, and the fit to it, with ``model="learn"``."""
        return self._collection

    def state_dict(self) -> dict[str, Any]:
        """Return what is remembered of the episodes under way."""
        state: dict[str, Any] = {"over": torch.from_numpy(self._over)}
        state |= {f"memory.{name}": field for name, field in (self.memory or {}).items()}
        if self._loop.residual is not None:
            state["residual"] = self._loop.residual.get_extra_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from there, after a first reset.

        Raises:
            ConfigurationError: for other names, shapes or numbers than :meth:`state_dict` gives;
                nothing is changed then.
        """
        state, present = dict(state), self.state_dict()
        fit, known = state.pop("residual", None), present.pop("residual", None)
        if self.memory is None:
            present |= {name: None for name in state if name.startswith("memory.")}
        if (fit is None) != (known is None):
            raise ConfigurationError(
                "wrapper.load_state_dict: expected a state with a residual if, and only if, this "
                "wrapper has residual_steps; make the wrapper with the option of the saved one"
            )
        state = check_state("wrapper", state, present)
        self._over = state.pop("over").numpy().copy()
        self.memory = {name.removeprefix("memory."): field for name, field in state.items()}
        if fit is not None:
            self._loop.residual.set_extra_state(fit)

    @torch.no_grad()
    def _begin(
        self,
        observations: Any,
        states: Tensor,
        rows: np.ndarray | None = None,
        seed: int | None = None,
    ) -> dict[str, Any]:
        """Begin episodes in ``states`` ``(N, S)``, or only those of ``rows``; return the record."""
        if self._collection is not None and seed is not None:
            self._collection.restart(seed)
        fits = self._collection is not None and self._collection.fits()
        if self.memory is None or fits:
            self.memory = None
            self._complete(observations, states)
        self._episodes += 1 if rows is None else rows
        memory, step = self._loop.begin(states, self._spec, self.learnt)
        self.hold(memory, None if rows is None else torch.from_numpy(rows))
        return self._describe(step)

    def _complete(self, observations: Any, states: Tensor) -> None:
        """Build what depends on size and precision of the state."""
        if self._observed_in is None and np.array_equal(observations, states.numpy()):
            self._observed_in = _same
        collection, delay = self._collection, self.options["delay"]
        if self._observed_in is None and delay is not None and self.options["delay_compensation"]:
            raise ConfigurationError(f"ActionFlowWrapper: delay={delay!r}: {UNKNOWN}")
        size, count = states.shape[-1], self._actions.shape[0]
        model = self._model if collection is None else collection.fitted
        if model is None:
            model = UnknownDynamics(Manifold(size), count)
        elif not isinstance(model, DynamicsModel):
            model = KnownDynamics(model, Manifold(size), count)
        if states.dim() != 2 or size != model.state_size:
            raise ConfigurationError(
                f"ActionFlowWrapper: the state has {tuple(states.shape[1:])} numbers, that of the "
                f"model {model.state_size}; say what it is by state=lambda env, observation: ..."
            )
        if isinstance(model, MuJoCoDynamics) and model.home is None:
            model.home = model.home_at(states[0, : model.mjcf.nq].numpy())
        if isinstance(model, MuJoCoDynamics) and self._own:
            try:
                model.check_range(self._actions.low, self._actions.high)
            except ConfigurationError as error:
                raise ConfigurationError(f"ActionFlowWrapper: {error}") from error
        low, high = (torch.as_tensor(x).to(states) for x in (self._actions.low, self._actions.high))
        self._spec = Bounded(low, high, low.shape, dtype=low.dtype)
        loop = CorrectionLoop("wrapper", model, self._corrector, **self.options)
        self._loop = loop.complete(action_spec=self._spec)
        if collection is not None and collection.fitted is None:
            self._loop = collection.collecting(self._loop)
        self._loop.corrector.to(states.dtype)

    def _act(self, planned: Tensor) -> tuple[np.ndarray, dict[str, Any]]:
        """Return what to execute instead of ``planned`` ``(N, A)``, and the record of it."""
        if self.memory is None:
            raise ResetNeeded("call reset() before step()")
        # A policy knows no effects beyond the space, as a planner may: these are cut first.
        given, space = planned.numpy(), self._actions
        np.clip(given, space.low, space.high, out=given, where=np.isfinite(given))
        self.memory, step = self._loop.act(self.memory, planned, self._spec)
        info = self._describe(step)
        return info["executed_action"].astype(self._actions.dtype), info

    def _observe(self, observations: Any, over: np.ndarray, info: dict[str, Any]) -> Any:
        """Add what the actions led to; return what is shown. Episodes are ``over`` ``(N,)``."""
        same_step = self._mode is AutoresetMode.SAME_STEP
        fresh = over if same_step else self._over
        states, before = self._states_in(observations), self.memory
        reached = states
        if fresh.any():  # what led into a new episode is no transition
            reached = states.masked_fill(torch.from_numpy(fresh).unsqueeze(-1), torch.nan)
        step = before["state"], before["executed_action"], reached
        self._steps.append((self._episodes.copy(), *step))
        self.memory = self._loop.observe(before, reached)
        if over.any() and self.options["belief"]:
            ends = enumerate(over)
            info["diagnosis"] = np.array([self._diagnosis(k) if end else "" for k, end in ends])
        if fresh.any():
            self._begin(observations, states, fresh)
        self._over = over & (self._mode is AutoresetMode.NEXT_STEP)
        return self._shown(observations, info, None if same_step else over)

    def _shown(
        self, observations: Any, info: dict[str, Any], over: np.ndarray | None = None
    ) -> Any:
        """Return the observations ``(N, ...)`` in the states in which the next actions act.

        Not where episodes are ``over`` ``(N,)``. Completes the record of the step.
        """
        memory, loop = self.memory, self._loop
        makes_up = loop.options["delay_compensation"]
        states = memory["state"]
        if makes_up:
            states, delay = loop.arrival(memory)
        else:
            delay = loop.delay_in(memory)
        steps = delay.numpy().copy()
        info |= {"delay": steps, "observation": observations}
        rows = (steps > 0) & (True if over is None else ~over)
        if not makes_up or not rows.any():
            return observations
        if self._observed_in is None:
            warn(f"ActionFlowWrapper: actions act late: {UNKNOWN}")
            return observations
        shown = np.array(observations)
        shown[rows] = self._observed_in(states.numpy()[rows])
        return shown

    def _diagnosis(self, row: int) -> str:
        """Say in words what the newest steps of an environment show of its actuators."""
        from afm_rl.diagnosis.pairs import judge_steps

        if not self._steps:
            return "nothing seen yet"
        steps = [(n[row], s[row], a[row], after[row]) for n, s, a, after in self._steps]
        corrector, loop = self._loop.corrector, self._loop
        model = loop.model if loop.residual is None else loop.model.of(row)
        found = judge_steps(model, self._names, steps, corrector.delay, self._actions)
        delay = int(corrector.delay_in(self.memory)[row])
        made_up = self.options["delay_compensation"] and self.options["enabled"]
        made_up &= self._observed_in is not None
        late = f"\nlateness: {delay} step{'s' * (delay > 1)}{', made up for' * made_up}"
        return f"{found}{late * (delay > 0)}"

    def _describe(self, step: Correction) -> dict[str, Any]:
        """Return the record of a step, ``(N, ...)`` each."""
        fields = step._asdict().items()
        info: Any = {name: x.numpy().copy() for name, x in fields if x is not None}
        if self._collection is not None:
            info["learned"] = np.full(len(self._over), self._collection.fitted is not None)
        if "belief" in info:
            causes, belief = self._loop.corrector.causes, info["belief"].swapaxes(0, 1)
            info["belief"] = dict(zip(causes, belief, strict=True))
        return info

    def _states_in(self, observations: Any) -> Tensor:
        """Return the states ``(N, S)``."""
        known = None if self.memory is None else self.memory["state"].shape
        return as_numbers("observations", self._state_of(self.env, observations), known)


class ActionFlowWrapper(GymnasiumShell, gymnasium.Wrapper, RecordConstructorArgs):
    r"""Corrects the actions of whatever policy acts in a gymnasium environment.

    The policy's action is the planned one. While the model explains what happens, it is executed
    as it is, brought into the action space; when it does not, the corrector's answer is. Seeds,
    rewards, ends and observations are the environment's own. It is a view of the
    :class:`~afm_rl.transforms.CorrectionLoop`, whose options it takes; its policy knows no effects
    beyond the action space, so ``extend_effect_bounds`` does nothing.

    ``info["afm"]`` is the record of the step, a :class:`~afm_rl.correction.Correction` by name:
    ``planned_action``, ``executed_action`` and ``predicted_effect`` ``(A,)``; ``corrected``,
    whether the planned action was replaced by the corrector's (with ``enabled=False``: whether it
    would be); the ``innovation``, in standard deviations of the model; the ``noise`` ``(A,)`` of
    the effects; the ``effect_bounds`` ``(2, A)``; and the ``delay``: steps until the next action
    acts, known and estimated ones; 0 with ``enabled=False``. A reference that follows a clock is
    read that far ahead. ``observation`` is what was measured. With ``belief=True`` there is the
    ``belief``, how probable ``(A,)`` each cause is, by name, such as ``"no fault"`` or
    ``"2 steps late"``, and at an episode's end the ``diagnosis``. With ``residual_steps`` it says
    whether the model is ``fitted``; :attr:`residual` has the rest. :attr:`diagnosis` says in words
    what the actuators seem to do, by the newest 150 steps.

    What the model takes for the state is, with ``"mujoco"`` or a
    :class:`~afm_rl.dynamics.MuJoCoDynamics`, the whole state of the environment's simulation, else
    the observation; ``state`` gives another.

    Args:
        env: with a vector of real numbers between finite bounds as action.
        model: ``"mujoco"``, the environment's own model as it is now, with its frame skip; a
            step function ``step(state, action) -> next_state`` in torch, batched; any
            :class:`~afm_rl.dynamics.DynamicsModel`; or ``"learn"``, which collects healthy steps
            and fits an ensemble between two episodes. A
            :class:`~afm_rl.transforms.collect_then_fit.CollectThenFit` has other settings. Then
            ``info["afm"]["learned"]`` says whether there is a model yet, and :attr:`collection` how
            many steps there are and how good the model is.
        state: ``state(env, observation)`` returns the state ``(S,)`` that the model knows; None:
            that of the simulation, else the observation.
        corrector: the correction, owned; None: an
            :class:`~afm_rl.correction.ActionFlow` for the action space.
        observe: ``observe(states)`` returns what is observed in states ``(N, S)``, arrays both;
            None: the states, if they are what is observed at the first reset, or what a gymnasium
            task with MuJoCo observes in them.
        action_map: with ``"mujoco"``, how the environment makes controls of actions, as
            :class:`~afm_rl.dynamics.MuJoCoDynamics` takes it, such as ``"range"``; None: actions
            are controls.

    Raises:
        ConfigurationError: for spaces or a model that cannot be used, or do not fit each other; at
            the first reset, if the action space is not the range of the simulation's controls and
            ``action_map`` is not given; at a step, for actions or states that are not real numbers
            of the right shape.

    >>> env = ActionFlowWrapper(gymnasium.make("Pendulum-v1"), "learn")
    >>> env.reset(seed=0)[1]["afm"]["learned"]
    False
    >>> _, _, _, _, info = env.step(np.zeros(1, dtype=np.float32))
    >>> info["afm"]["corrected"], env.collection.count
    (False, 1)
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode, with an empty memory or what was learnt."""
        observation, info = self.env.reset(seed=seed, options=options)
        step = self._begin([observation], self._states_in([observation]), seed=seed)
        (shown,) = self._shown([observation], step)
        return shown, {**info, "afm": row_of(step)}

    def step(self, action: Any):
        """Execute the corrected action."""
        planned = as_numbers("action", action, self.action_space.shape)
        (executed,), step = self._act(planned[None])
        observation, reward, terminated, truncated, info = self.env.step(executed)
        (shown,) = self._observe([observation], np.array([terminated or truncated]), step)
        return shown, reward, terminated, truncated, {**info, "afm": row_of(step)}

    @property
    def residual(self) -> Any:
        """What is known of the fit, with ``residual_steps``; None before the first reset."""
        found = super().residual
        return found and type(found)(*(row_of(each, 0) for each in found))

    @property
    def diagnosis(self) -> str:
        """What the actuators seem to do, in words; takes a tenth of a second for each."""
        return self._diagnosis(0)

    def _states_in(self, observations: Any) -> Tensor:
        known = None if self.memory is None else self.memory["state"].shape[1:]
        return as_numbers("observation", self._state_of(self.env, observations[0]), known)[None]


class ActionFlowVectorWrapper(GymnasiumShell, VectorWrapper, RecordConstructorArgs):
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

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        """Begin episodes, only those in ``options["reset_mask"]`` if it is given."""
        rows = (options or {}).get("reset_mask")
        rows = np.ones(self.env.num_envs, dtype=bool) if rows is None else rows.copy()
        observations, infos = self.env.reset(seed=seed, options=options)
        first = seed[0] if isinstance(seed, list | tuple) else seed
        step = self._begin(observations, self._states_in(observations), rows, first)
        self._over &= ~rows
        shown = self._shown(observations, step)
        return shown, {**infos, "afm": step, "_afm": rows}

    def step(self, actions: Any):
        """Execute the corrected actions."""
        executed, step = self._act(as_numbers("actions", actions, self.action_space.shape))
        observations, rewards, terminated, truncated, infos = self.env.step(executed)
        made, over = ~self._over, np.asarray(terminated) | np.asarray(truncated)
        shown = self._observe(observations, over, step)
        return shown, rewards, terminated, truncated, {**infos, "afm": step, "_afm": made}

    @property
    def diagnosis(self) -> list[str]:
        """What the actuators of each environment seem to do, in words."""
        return [self._diagnosis(row) for row in range(self.num_envs)]


def row_of(info: Any, row: int = 0) -> Any:
    """Return the part of one environment."""
    if isinstance(info, dict):
        return {name: row_of(value, row) for name, value in info.items()}
    return info[row].item() if isinstance(info[row], np.generic) else info[row]


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


def _collection(model: Model) -> CollectThenFit | None:
    """Return what collects data and fits a model, if there is none yet."""
    if callable(model) or isinstance(model, str) and model != "learn":
        return None
    from afm_rl.transforms.collect_then_fit import CollectThenFit

    if isinstance(model, CollectThenFit):
        return deepcopy(model)
    return CollectThenFit() if isinstance(model, str) else None


def as_numbers(key: str, given: Any, shape: Sequence[int] | None) -> Tensor:
    """Return real numbers of a host, of a shape (None: of any), as a tensor, a copy.

    Raises:
        ConfigurationError: for anything else, naming what was given and what was expected.

    >>> as_numbers("action", [1, 0.5], (2,))
    tensor([1.0000, 0.5000], dtype=torch.float64)
    """
    if isinstance(given, Tensor):
        given = given.detach().cpu().clone()
    else:
        with suppress(TypeError, ValueError):  # what is no array
            given = torch.from_numpy(np.array(given))
    numbers = check_numbers(key, given, shape)
    precise = numbers.dtype in (torch.float32, torch.float64)
    return numbers if precise else numbers.to(torch.get_default_dtype())


def _observed(env: Any, observation: Any) -> Any:
    return observation


def _same(states: np.ndarray) -> np.ndarray:
    return states


def _observed_in(simulation: Simulation, states: np.ndarray) -> np.ndarray:
    return simulation.observe(states)["observation"]


def _vector_state(model: MuJoCoDynamics, env: Any, observations: Any) -> np.ndarray:
    """Return those of each simulation, without activations where these run elsewhere."""
    envs = getattr(env.unwrapped, "envs", None)
    if envs is None:
        return np.stack(env.unwrapped.call("state_vector"))
    return states_of(envs, model)


def _simulation(source: Any, action_map: ActionMap | None) -> MuJoCoDynamics:
    """Return the MuJoCo model of an environment, or of the first of a vector of them."""
    try:
        inner: Any = source.unwrapped
        if not isinstance(source, VectorEnv):
            return MuJoCoDynamics(inner, action_map=action_map)
        if getattr(inner, "envs", None):
            return MuJoCoDynamics(inner.envs[0], action_map=action_map)
        model, skip = inner.get_attr("model")[0], inner.get_attr("frame_skip")[0]
        return MuJoCoDynamics(model, skip, action_map=action_map)
    except (ConfigurationError, AttributeError) as error:
        raise ConfigurationError(
            f"ActionFlowWrapper: model='mujoco', but {source} has no MuJoCo model ({error}); give "
            "a step function, a DynamicsModel, or 'learn'"
        ) from error
