"""The tick of the correction for environments that speak numpy."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from torch import Tensor
from torchrl.data import Bounded

from afm_rl.correction import ActionFlow, Corrector
from afm_rl.correction.delay import arrival
from afm_rl.correction.pairs import PairCorrector
from afm_rl.dynamics import DynamicsModel, KnownDynamics, MuJoCoDynamics, UnknownDynamics
from afm_rl.errors import ConfigurationError, check_choice, check_flag, check_instance
from afm_rl.faults import fault_of, safe_action
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms.memory import (
    LATE,
    UNSEEN,
    begin,
    computable,
    correct,
    corrector_for,
    observe,
    precise,
)
from afm_rl.transforms.simulation import Simulation

if TYPE_CHECKING:  # rooms that are entered when they are asked for
    from afm_rl.learning.watching import Watching

Model: TypeAlias = "DynamicsModel | Callable[[Tensor, Tensor], Tensor] | Watching | str"
State = Callable[[Any, Any], Any]
Observe = Callable[[np.ndarray], Any]
AS_EXPECTED = "as the model expects"
UNKNOWN = f"{UNSEEN}; give observe=, a function from states (N, S) to observations, or late='leave'"
SHOWN = {
    "planned": "planned_action",
    "executed": "executed_action",
    "predicted": "predicted_effect",
    "corrects": "misaligned",
    "innovation": "innovation",
    "noise": "noise",
}
"""What ``info["afm"]`` has of the entries."""


class CorrectionLoop:
    """The tick of :mod:`~afm_rl.transforms.memory` for N environments that speak numpy.

    Args:
        observations: space of one observation.
        actions: space of one action.
        model: see :class:`ActionFlowWrapper`, as further arguments.
        state: reads the state.
        corrector: the correction.
        enabled: False to watch only.
        source: environment, or vector of environments, that may have a simulation.
        late: see :class:`ActionFlowWrapper`, as the next one.
        observe: what is observed in states.
        delay: steps that are known.
        belief: tell it, too.
        keep_memory_on_reset: go on with what was learnt.
    """

    def __init__(
        self,
        observations: gymnasium.Space,
        actions: gymnasium.Space,
        model: Model,
        state: State | None = None,
        corrector: Corrector | None = None,
        enabled: bool = True,
        source: Any = None,
        late: str = "predict",
        observe: Observe | None = None,
        delay: int | Sequence[int] | None = None,
        belief: bool = False,
        keep_memory_on_reset: bool = False,
    ) -> None:
        keep = check_flag("wrapper.keep_memory_on_reset", keep_memory_on_reset)
        self.keep_memory_on_reset = keep
        self.delay, self.belief = delay, check_flag("wrapper.belief", belief)
        self.late = check_choice("wrapper.late", late, LATE)
        if not isinstance(actions, Box) or len(actions.shape) != 1 or actions.dtype.kind != "f":
            raise ConfigurationError(
                f"ActionFlowWrapper: action_space={actions}: expected a Box of one vector of real "
                "numbers"
            )
        self.space, self.enabled = actions, check_flag("wrapper.enabled", enabled)
        self.watching = _watching(model)
        self.model: Any = None if self.watching else model
        if isinstance(model, str) and model == "mujoco":
            self.model = _simulation(source)
        elif isinstance(model, str) and model != "learn" or not callable(self.model or len):
            raise ConfigurationError(
                f"ActionFlowWrapper: model={model!r}: expected 'mujoco', 'learn', a step function "
                "or a DynamicsModel"
            )
        self.corrector: Any = corrector
        if state is None and isinstance(self.model, MuJoCoDynamics):
            state = _vector_state if isinstance(source, VectorEnv) else _env_state
            simulation = Simulation(source)
            if observe is None and simulation.seen:
                observe = partial(_observed_in, simulation)
        self.seen_in: Observe | None = observe  # None: known at the first reset, or not at all
        if state is None and not (isinstance(observations, Box) and len(observations.shape) == 1):
            raise ConfigurationError(
                f"ActionFlowWrapper: observation_space={observations}: expected a Box of one "
                "vector; say what the state is by state=lambda env, observation: ..."
            )
        self.state: State = _observed if state is None else state
        names = self.model.names[1] if isinstance(self.model, MuJoCoDynamics) else None
        self.names = names or [f"actuator {k}" for k in range(actions.shape[0])]
        self.entries: Any = None  # a tensordict, from the first reset on

    @property
    def _keeps(self) -> bool:
        return self.keep_memory_on_reset and self.entries is not None

    @property
    def learning(self) -> bool:
        """Is there no model yet?"""
        return self.watching is not None and self.watching.fitted is None

    @property
    def state_shape(self) -> tuple[int, ...] | None:
        """Shape of one state, once it is known."""
        return None if self.entries is None else tuple(self.states.shape[1:])

    @property
    def predicts(self) -> bool:
        """Are observations at arrival shown while commands act late?"""
        return self.late == "predict" and self.enabled and not self.learning

    @torch.no_grad()
    def begin(
        self,
        states: Tensor,
        rows: np.ndarray | None = None,
        seed: int | None = None,
        observations: Any = None,
    ) -> None:
        """Begin episodes in ``states`` ``(N, S)``; only in ``rows`` ``(N,)``, if given.

        Args:
            states: of all environments.
            rows: in which of them.
            seed: of the noise of watching.
            observations: what was measured ``(N, ...)``; the states themselves if None.
        """
        states = states.to(precise(states.dtype))
        if self.watching and seed is not None:
            self.watching.restart(seed)
        if self.entries is None:
            self._complete(states, states if observations is None else observations)
        before = self.entries.get("memory") if self._keeps else None
        if self.watching and self.learning and self.watching.due:
            self.watching.learn()
            self.model, rows, before = self.watching.fitted or self.model, None, None
        fresh = begin(self.corrector, states, self.spec, before)
        if rows is None or self.entries is None:
            self.entries, self.states = fresh, states
        else:
            mask = torch.from_numpy(rows)
            self.entries = torch.where(mask, fresh, self.entries)
            self.states = torch.where(mask.unsqueeze(-1), states, self.states)
        self.told = self._tell()

    def _complete(self, states: Tensor, observations: Any) -> None:
        """Build what depends on size and precision of the state."""
        if self.seen_in is None and np.array_equal(observations, states.numpy()):
            self.seen_in = _states
        if self.seen_in is None and self.delay is not None and self.late == "predict":
            raise ConfigurationError(f"ActionFlowWrapper: delay={self.delay!r}: {UNKNOWN}")
        size, count = states.shape[-1], self.space.shape[0]
        if self.model is None:
            self.model = UnknownDynamics(Manifold(size), count)
        elif not isinstance(self.model, DynamicsModel):
            self.model = KnownDynamics(self.model, Manifold(size), count)
        if states.dim() != 2 or size != self.model.state_size:
            raise ConfigurationError(
                f"ActionFlowWrapper: the state has {tuple(states.shape[1:])} numbers, that of the "
                f"model {self.model.state_size}; say what it is by "
                "state=lambda env, observation: ..."
            )
        low, high = (torch.as_tensor(x).to(states) for x in (self.space.low, self.space.high))
        self.spec = Bounded(low, high, low.shape, dtype=low.dtype)
        self.corrector = corrector_for(
            "ActionFlowWrapper", self.model, self.corrector, self.spec, self.delay
        )
        if self.belief:
            check_instance("wrapper.belief=True: wrapper.corrector", self.corrector, ActionFlow)
        self.corrector.to(states.dtype)

    @torch.no_grad()
    def act(self, planned: Tensor) -> np.ndarray:
        """Return what to execute instead of ``planned`` ``(N, A)``."""
        if self.entries is None:
            raise ResetNeeded("call reset() before step()")
        if self.watching and self.learning:
            self._explore(planned)
        else:
            memory, how = self.entries.get("memory"), (self.spec, self.enabled)
            # A policy knows no effects beyond the space, as a planner may: these are cut first.
            space = self.spec.space
            inside = planned.clamp(space.low.to(planned), space.high.to(planned))
            planned = torch.where(planned.isfinite(), inside, planned)
            self.entries = correct(memory, planned, self.model, self.corrector, *how)
        self.told = self._tell()
        return self.told["executed"].astype(self.space.dtype)

    def _explore(self, planned: Tensor) -> None:
        """Execute plans ``(N, A)`` with noise, which shows what actions do."""
        low, high = self.spec.space.low, self.spec.space.high
        wanted = computable(planned, low, high, self.states.dtype)
        noise = self.watching.excitation(wanted.shape)  # type: ignore[union-attr]
        noisy = wanted + noise.to(wanted) * (high - low) / 2
        executed, _ = safe_action(noisy, low, high, self.entries.get("executed_action"))
        found = {"planned": wanted, "executed": executed, "predicted": executed}
        self.entries.update({SHOWN[name]: value for name, value in found.items()})

    @torch.no_grad()
    def observe(self, states: Tensor, fresh: np.ndarray | None = None) -> None:
        """Add what the actions led to, ``(N, S)``; where ``fresh`` ``(N,)``, an episode began."""
        states, entries = states.to(precise(states.dtype)), self.entries
        fresh = np.zeros(len(states), dtype=bool) if fresh is None else fresh
        if self.watching and self.learning:
            executed, valid = entries.get("executed_action"), torch.from_numpy(~fresh)
            self.watching.add(self.states, executed, states, valid)
        else:
            # What led into a new episode is no transition.
            reached = states.masked_fill(torch.from_numpy(fresh).unsqueeze(-1), torch.nan)
            memory = observe(entries.get("memory"), reached, self.model, self.corrector)
            entries.set("memory", memory)
        self.states, told = states, self.told
        if fresh.any():
            self.begin(states, fresh)
            self.told = told

    @torch.no_grad()
    def at_arrival(self, observations: Any, over: np.ndarray | None = None) -> Any:
        """Return the observations ``(N, ...)`` in the states in which the next commands act.

        In how many steps that is, is noted in :attr:`told`.

        Args:
            observations: what was measured.
            over: where episodes have ended, and nothing is predicted, ``(N,)``.
        """
        memory = self.entries.get("memory")
        if self.predicts:
            states, steps = arrival(self.corrector, memory, self.model)
        else:
            states, steps = self.states, self.corrector.under_way(memory)[2] * self.enabled
        self.told["delay"] = steps.numpy().copy()
        rows = (steps > 0).numpy() & (True if over is None else ~over)
        if not self.predicts or not rows.any():
            return observations
        if self.seen_in is None:
            warnings.warn(f"ActionFlowWrapper: commands act late: {UNKNOWN}", stacklevel=3)
            return observations
        found = np.array(observations)
        found[rows] = self.seen_in(states.numpy()[rows])
        return found

    def diagnosis(self, row: int) -> str:
        """Say in words what the pairs that an environment remembers show of its actuators."""
        if self.entries is None:
            return AS_EXPECTED
        memory, size = self.entries.get("memory")[row], len(self.names)
        late, text = int(self.corrector.under_way(memory)[2]), AS_EXPECTED
        found = late - self.corrector.delay  # beside the steps that are known
        changed = found > 0 or bool(self.entries.get("misaligned")[row])
        if changed and isinstance(self.corrector, PairCorrector):
            pairs = self.corrector.unpack(memory, self.states.shape[-1])["pairs"][:, : 3 * size + 1]
            parts = (x.numpy() for x in pairs.split([size, size, size, 1], 1))
            executed, effective, std, valid = parts
            use, step = valid[:, 0] > 0, getattr(self.model, "dt", 1.0)
            from afm_rl.diagnosis import explain

            how = {"std": std[use], "step": step, "delays": max(5, found + 1)}
            text = str(explain(executed[use], effective[use], self.names, **how))
        if late:
            shown = self.predicts and self.seen_in is not None
            text += f"\nlateness: {late} step{'s' * (late > 1)}{', made up for' * shown}"
        return text

    def _tell(self) -> dict[str, Any]:
        """Return what is known of the newest step, ``(N, ...)`` each."""
        found = {name: self.entries.get(key) for name, key in SHOWN.items()}
        told: dict[str, Any] = {name: value.numpy().copy() for name, value in found.items()}
        told["corrects"] &= self.enabled
        if self.watching:
            told["learned"] = np.full(len(told["corrects"]), not self.learning)
        if self.belief:
            belief = self.corrector.belief_in(self.entries.get("memory")).numpy()
            told["belief"] = dict(zip(self.corrector.causes, belief.swapaxes(0, 1), strict=True))
        return told


def _watching(model: Model) -> Watching | None:
    """Return what collects data and fits a model, if there is none yet."""
    if callable(model) or isinstance(model, str) and model != "learn":
        return None
    from afm_rl.learning.watching import Watching

    if isinstance(model, Watching):
        return deepcopy(model)
    return Watching() if isinstance(model, str) else None


def as_numbers(name: str, given: Any, shape: Sequence[int] | None) -> Tensor:
    """Return real numbers of a shape (None: of any) as a tensor, a copy.

    Raises:
        ConfigurationError: for anything else, naming what was given and what was expected.

    >>> as_numbers("action", [1, 0.5], (2,))
    tensor([1.0000, 0.5000], dtype=torch.float64)
    """
    if isinstance(given, Tensor) and given.dtype is torch.bfloat16:  # which numpy does not know
        given = given.float()
    try:
        numbers = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given)
    except ValueError:  # lists of several lengths
        numbers = np.asarray(None)
    found: Any = torch.tensor(numbers) if numbers.dtype.kind in "iufcb" else given
    fault = fault_of(found, np.shape(numbers) if shape is None else shape)
    if fault:
        raise ConfigurationError(f"ActionFlowWrapper: {name}: {fault}")
    return found if found.is_floating_point() else found.to(torch.get_default_dtype())


def _observed(env: Any, observation: Any) -> Any:
    return observation


def _states(states: np.ndarray) -> np.ndarray:
    return states


def _observed_in(simulation: Simulation, states: np.ndarray) -> np.ndarray:
    return simulation.observe(states)["observation"]


def _env_state(env: Any, observation: Any) -> np.ndarray:
    """Return positions, velocities and activations of a simulation."""
    data = env.unwrapped.data
    return np.concatenate([data.qpos, data.qvel, data.act])


def _vector_state(env: Any, observations: Any) -> np.ndarray:
    """Return positions and velocities of each simulation."""
    return np.stack(env.unwrapped.call("state_vector"))


def _simulation(source: Any) -> MuJoCoDynamics:
    """Return the MuJoCo model of an environment, or of the first of a vector of them."""
    try:
        inner: Any = source.unwrapped
        if not isinstance(source, VectorEnv):
            return MuJoCoDynamics(inner)
        return MuJoCoDynamics(inner.get_attr("model")[0], inner.get_attr("frame_skip")[0])
    except (ConfigurationError, AttributeError) as error:
        raise ConfigurationError(
            f"ActionFlowWrapper: model='mujoco', but {source} has no MuJoCo model ({error}); give "
            "a step function, a DynamicsModel, or 'learn'"
        ) from error
