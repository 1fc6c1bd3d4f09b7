"""The transform between planner and environment."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import FrameSkipTransform

from afm_rl.compiling.tracing import all_hold, may_look
from afm_rl.correction import Corrector
from afm_rl.correction.base import Fields
from afm_rl.dynamics import DynamicsModel, KnownDynamics
from afm_rl.dynamics.action_map import ActionMap
from afm_rl.errors import ConfigurationError, check_choice, check_instance, warn
from afm_rl.options import options
from afm_rl.spaces.keys import as_key, as_keys
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import delay_compensation as delays
from afm_rl.transforms.actions import bounds_of, precise
from afm_rl.transforms.loop import CorrectionLoop
from afm_rl.transforms.loop_options import LoopOptions
from afm_rl.transforms.memory import MemoryHolder, check_version, entries_of, warn_of_old
from afm_rl.transforms.simulation import (
    SIMULATOR_STATE,
    Simulation,
    check_action_map,
    simulation_in,
)
from afm_rl.transforms.stateful import StatefulTransform

UNKNOWN = delays.UNKNOWN.format("put the transform before those that change observations")


class ActionFlowTransform(MemoryHolder, StatefulTransform):
    r"""Action Flow Matching: the planned action goes in, the action with its effect comes out.

    A view of the :class:`~afm_rl.transforms.CorrectionLoop`, whose options it takes. On the way to
    the environment the planned action is corrected; on the way back the transition enters the
    memory. The dynamics model is shared with planner and updater; while it learns, the newest
    transitions are measured again by the *present* model.

    Every mission of a batch has a memory of its own, which a reset empties. Under ``prefix`` are
    the entries of the loop (the root action stays the planned one, which losses of policies need;
    models learn from the executed one), and

    * ``(prefix, "observation")`` and ``(prefix, "arrival")`` ``(*B, S)``: the measured state, and
      the state in which the next action will act; they are equal while no action is late,
    * ``(prefix, "delay")`` ``(*B)``: steps until then, an integer; 0 without a delay, and while the
      correction is switched off.

    The memory is large, so it is not in rollouts or in what collectors yield: the memory of the
    latest step is held here, as :attr:`memory`, fields by name, and is in the state dict. With a
    tensordict of another step the correction restarts with an empty memory, and warns. To return
    to a step, or to continue in another environment, load the state dict of that step.

    Put it first in a ``Compose``: what follows may rescale the observation under another key
    and the action. It needs the state as the model knows it.

    ``"simulator_state"`` is the complete state of the MuJoCo simulation inside the environment,
    which may observe less. It is read there, unless :class:`~afm_rl.transforms.SimulatorState` has
    written it, which is necessary around workers. Policies receive the observation at arrival, and
    ``(prefix, "observation")`` is the measured *observation*; if that has several entries, a
    tensordict of them.

    Args:
        model: dynamics model, shared (it does not become part of the state dict); a step function
            ``step(state, action) -> next_state``, batched; ``"mujoco"``: the environment's
            simulation as it is at first, with the frames that are skipped.
        corrector: the correction, owned; None: an
            :class:`~afm_rl.correction.ActionFlow` for the action box.
        in_keys: the state; if None, ``["simulator_state"]`` with ``"mujoco"``, else
            ``["observation"]``.
        in_keys_inv: the action; ``["action"]`` if None.
        prefix: where the entries are.
        reported_key: where the environment reports the action ``(*B, A)`` that its actuators gave
            in a step, if that is known and not what they were sent: motors that lag.
        action_map: with ``"mujoco"``, how the environment makes controls of actions, as
            :class:`~afm_rl.dynamics.MuJoCoDynamics` takes it; None: actions are controls.

    Raises:
        ConfigurationError: for parts that do not fit each other, also when it is put around an
            environment.

    >>> import torch
    >>> from torchrl.envs import TransformedEnv
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> world = PlanningEnv(Dubins(), GoalDistance(), low, high)  # any TorchRL env will do
    >>> env = TransformedEnv(world, ActionFlowTransform(Dubins()))
    >>> env.rollout(5)["next", "afm", "executed_action"].shape
    torch.Size([5, 2])
    """

    @options("transform")
    def __init__(
        self,
        model: DynamicsModel | Callable[[Tensor, Tensor], Tensor] | str,
        corrector: Corrector | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        in_keys_inv: Sequence[NestedKey] | None = None,
        prefix: NestedKey = "afm",
        reported_key: NestedKey | None = None,
        action_map: ActionMap | None = None,
        **options: Unpack[LoopOptions],
    ) -> None:
        state, known = "observation", None
        function: tuple[Any, ...] = ()  # in a tuple, so that no module is registered
        if callable(model) and not isinstance(model, DynamicsModel):
            function = (model,)
        elif isinstance(model, str):
            check_choice("transform.model", model, ["mujoco"])
            state = SIMULATOR_STATE
        else:
            known = check_instance("transform.model", model, DynamicsModel)
        super().__init__(
            _one_key("in_keys", [state] if in_keys is None else in_keys),
            _one_key("in_keys_inv", ["action"] if in_keys_inv is None else in_keys_inv),
            prefix,
        )
        check_action_map("transform", action_map, model)
        self._function, self._action_map = function, action_map
        loop = CorrectionLoop("transform", known, corrector, **options)
        self._loop = loop if corrector is None or known is None else loop.complete()
        self._corrector, self._residual = corrector, self._loop.residual  # registered here
        self._simulation: Any = (None, None)
        self._acted: Fields = {}  # the memory of a step that the environment has yet to make
        rate = self.options["max_correction_rate"]
        if rate is not None and reported_key is not None:
            raise ConfigurationError(
                f"transform.max_correction_rate={rate!r}: with reported_key the command of the "
                "step before is not remembered; give max_correction, or leave reported_key out"
            )
        self.reported_key = None if reported_key is None else as_key(reported_key)

    @property
    def loop(self) -> CorrectionLoop:
        """The loop; what is not given is made for the environment: simulation and corrector."""
        loop = self._loop
        if loop.model is not None and loop.corrector is not None:
            return loop
        if self.parent is None:
            raise ConfigurationError(
                "ActionFlowTransform: simulation and action box are not known yet; put the "
                "transform around an environment first, or give model and corrector"
            )
        model = loop.model
        if self._function:
            state = self._entry("in_keys", self.parent.full_observation_spec)
            sizes = state.shape[-1], self._action_spec.shape[-1]
            model = KnownDynamics(self._function[0], Manifold(sizes[0]), sizes[1])
        elif model is None:
            try:
                bounds = bounds_of(self._action_spec)
                model = Simulation(self.parent).dynamics(*bounds, self._action_map)
            except ConfigurationError as error:
                raise ConfigurationError(f"ActionFlowTransform: model='mujoco': {error}") from error
        self._loop = loop.complete(model, self._action_spec)
        self._corrector, self._residual = self._loop.corrector, self._loop.residual
        return self._loop

    @property
    def model(self) -> DynamicsModel:
        """The dynamics model, shared."""
        return self.loop.model if self._loop.model is None else self._loop.model

    @property
    def corrector(self) -> Corrector:
        """The correction; an ActionFlow for the environment's action box if none was given."""
        return self.loop.corrector if self._loop.corrector is None else self._loop.corrector

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        """Add the memory to a state dict, ``memory.NAME`` of each field."""
        if self.parent is not None:
            self.loop  # noqa: B018  # the corrector belongs to the state from then on
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self.memory is not None:
            fields = self.memory.items()
            destination.update({f"{prefix}memory.{name}": field for name, field in fields})

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *others: Any) -> None:
        """Continue with the memory of a state dict, or without one."""
        check_version("ActionFlowTransform", state_dict, prefix)
        if self.parent is not None:
            self.loop  # noqa: B018
        start = f"{prefix}memory."
        names = [name for name in state_dict if name.startswith(start)]
        fields = {name.removeprefix(start): state_dict.pop(name) for name in names}
        self.memory = fields or None
        super()._load_from_state_dict(state_dict, prefix, *others)

    @property
    def simulation(self) -> Simulation | None:
        """The simulation that the state is of, if it is ``"simulator_state"``."""
        parent, simulation = self._simulation
        if self.observation_key == SIMULATOR_STATE and parent is not self.parent:
            simulation = simulation_in(self.parent)
            delay = self.options["delay"] if self.options["delay_compensation"] else None
            if simulation is not None and delay is not None and not simulation.seen:
                raise ConfigurationError(f"ActionFlowTransform: delay={delay!r}: {UNKNOWN}")
            self._simulation = self.parent, simulation
        return simulation

    @property
    def _action_spec(self):
        return self._entry("in_keys_inv", self.parent.full_action_spec)

    def _entry(self, name: str, specs: Composite) -> TensorSpec:
        """Return the environment's spec of ``in_keys`` or ``in_keys_inv``."""
        (key,) = getattr(self, name)
        found = specs.get(key, None)
        if found is None:
            raise ConfigurationError(
                f"ActionFlowTransform: {name}=[{key!r}]: the environment has no such entry, but "
                f"{list(specs.keys(True, True))}{self._way if name == 'in_keys' else ''}"
            )
        return found

    @property
    def _way(self) -> str:
        """Where the whole state is, for messages."""
        if self.observation_key == SIMULATOR_STATE or simulation_in(self.parent) is None:
            return ""
        way = "the whole state of its simulation is in_keys=['simulator_state'], or model='mujoco'"
        return f"; {way}"

    def recall(self, tensordict: TensorDictBase) -> Fields | None:
        """Return the memory of each mission, an empty one where the step is another one's.

        A memory belongs to the state that it has seen last; a simulation has that itself.
        """
        entries, memory = tensordict.get(self.prefix, None), self.memory
        if entries is None:
            return None
        arrival = entries.get("arrival")
        follows = arrival.new_zeros(arrival.shape[:-1], dtype=torch.bool)
        if memory is not None and memory["state"].shape[:-1] == follows.shape:
            if self.simulation is not None:
                return memory
            if memory["state"].device != arrival.device:
                memory = {name: field.to(arrival.device) for name, field in memory.items()}
                self.memory = memory
            follows = _same(memory["state"], entries.get("observation"))
            if all_hold(follows):
                return memory
        if may_look(follows):
            warn(
                "ActionFlowTransform: this tensordict is not from the latest step. Only the latest "
                "step's memory is kept, so the correction restarts with an empty memory; continue "
                "with step_mdp(tensordict), or load the state_dict() of its step"
            )
        memory, _ = self.loop.begin(arrival, self._action_spec, self.learnt)
        self.hold(memory, ~follows)
        return self.memory

    def act(self, tensordict: TensorDictBase, memory: Fields) -> TensorDictBase:
        """Replace the planned action by the corrected one."""
        warn_of_old(tensordict, self.prefix)
        planned = tensordict.get(self.action_key, None)
        enabled = tensordict.get(self.key("enabled"), None)
        memory, step = self.loop.act(memory, planned, self._action_spec, self.action_key, enabled)
        self._acted = memory
        tensordict.set(self.action_key, step.executed_action)
        measured = tensordict.get(self.prefix).select("observation", "arrival", "delay")
        if self.simulation is None:
            # Environments without a state of their own continue from the entry under this key.
            tensordict.set(self.observation_key, measured.get("observation"))
        return tensordict.set(self.prefix, measured.update(entries_of(step)))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries, memory = dict(tensordict.get(self.prefix).items()), self._acted
        if self.reported_key is not None:
            given = next_tensordict.get(self.reported_key).to(memory["state"].dtype)
            memory = self.corrector.reported(memory, given)
        state = self._state(next_tensordict)
        memory = self.loop.observe(memory, state, self.observation_key)
        self.hold(memory)
        entries |= self._seen(memory, state, next_tensordict, entries["enabled"])
        # Of the device that the next tensordict names: else every entry is moved to where it is.
        batch = memory["state"].shape[:-1]
        later = TensorDict(entries, batch, device=next_tensordict.device)
        return next_tensordict.set(self.prefix, later)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_process()
        state = self._state(tensordict_reset)
        if state is None:
            self._entry("in_keys", self.parent.full_observation_spec)
        memory, step = self.loop.begin(state, self._action_spec, self.learnt)
        self.hold(memory, self._rows(tensordict))
        entries = entries_of(step)
        entries.update(self._seen(memory, state, tensordict_reset))
        return tensordict_reset.set(self.prefix, entries)

    def _rows(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return which missions begin, or which of their agents; None: all."""
        keys, memory_key = self.parent.reset_keys, self.key("memory")
        for key in keys:
            node = key[:-1] if isinstance(key, tuple) else ()
            if memory_key[: len(node)] == node:
                rows = tensordict.get(key, None)
                if rows is not None:
                    batch = tensordict.get(node) if node else tensordict
                    rows = rows.flatten(batch.batch_dims).any(-1)
                return rows
        raise ConfigurationError(
            f"ActionFlowTransform: prefix={self.prefix!r}: episodes end by {keys}, so that nothing "
            f"else is reset; give a prefix there, such as {(*keys[0][:-1], 'afm')!r}"
        )

    def _state(self, tensordict: TensorDictBase) -> Any:
        """Return the measured state; None if there is none."""
        state = tensordict.get(self.observation_key, None)
        if state is None and self.simulation is not None:
            state = self.simulation.state_for(self.model).to(tensordict.device or "cpu")
        return state

    def _seen(
        self,
        memory: Fields,
        state: Tensor,
        tensordict: TensorDictBase,
        enabled: Tensor | None = None,
    ) -> dict[str, Any]:
        """Return the entries of what was measured and of where the next action acts."""
        reached, delay = self.loop.arrival(memory, enabled)
        reached = torch.where((delay > 0).unsqueeze(-1), reached.to(state.dtype), state)
        measured = self._measured(tensordict, state).clone()
        if self.options["delay_compensation"]:
            self._show(tensordict, reached, delay > 0)
        return {"observation": measured, "arrival": reached, "delay": delay}

    @property
    def _seen_keys(self) -> list[NestedKey]:
        """Keys of the observations of a simulation, if they are known at arrival."""
        return [] if self.simulation is None else self.simulation.seen

    def _measured(self, tensordict: TensorDictBase, state: Tensor) -> Any:
        """Return the observation, before it is replaced: of a simulation, or the state."""
        if len(self._seen_keys) > 1:
            return tensordict.select(*self._seen_keys)
        return tensordict.get(*self._seen_keys) if self._seen_keys else state

    def _show(self, tensordict: TensorDictBase, reached: Tensor, late: Tensor) -> None:
        """Let policies find what is observed in the state in which their action will act."""
        if self.simulation is None:
            tensordict.set(self.observation_key, reached)
        elif self.simulation.seen and late.any():
            self.simulation.show(tensordict, reached, late)
        elif late.any():
            warn(f"ActionFlowTransform: actions act late: {UNKNOWN}")

    def _check_process(self) -> None:
        """Refuse a copy of a model that learns in another process: it would stay behind."""
        if self.model.taught_in not in (None, os.getpid()):
            raise ConfigurationError(
                "ActionFlowTransform: the dynamics model learns in another process, so that its "
                "copy in this one would never change; put the transform around ParallelEnv "
                "instead of inside, use a Collector instead of MultiSyncCollector, or a model "
                "that does not learn"
            )

    def _check_order(self) -> None:
        """Refuse to stand before a frame skip, which would have each frame corrected again."""
        chain = getattr(getattr(self.container, "transform", None), "transforms", [])
        for other in reversed(chain):
            if other is self:
                return
            if isinstance(other, FrameSkipTransform):
                raise ConfigurationError(
                    "ActionFlowTransform: a FrameSkipTransform follows it, and would have actions "
                    "that are corrected already corrected again; put FrameSkipTransform before "
                    "it, and give it a model of the whole stride"
                )

    def memory_spec(self, spec: Composite) -> Composite:
        """Return the specs of the entries."""
        self._check_order()
        specs = self.parent.full_observation_spec
        if self.simulation is not None and self.observation_key not in specs.keys(True, True):
            state = self.simulation.state
            found: TensorSpec = Unbounded((*spec.shape, *state.shape), dtype=state.dtype)
        else:
            found = self._entry("in_keys", specs)
        if not found.shape or found.shape[-1] != self.model.state_size:
            raise ConfigurationError(
                f"ActionFlowTransform: in_keys={self.in_keys}: of the shape "
                f"{tuple(found.shape)}, but the dynamics model's state has "
                f"{self.model.state_size} numbers{self._way}"
            )
        batch, kind = found.shape[:-1], precise(found.dtype)  # agents have a dimension of their own
        entries = self.loop.spec(batch, self._action_spec.dtype, kind)
        seen = Composite({key: specs[key] for key in self._seen_keys}, shape=spec.shape)
        first = next(iter(seen.values()), found)  # of one or none
        entries["observation"] = (seen if len(self._seen_keys) > 1 else first).clone()
        entries["arrival"] = Unbounded(found.shape, dtype=found.dtype)
        entries["delay"] = Unbounded(batch, dtype=torch.long)
        return entries


def _one_key(name: str, keys: Sequence[NestedKey]) -> NestedKey:
    found = as_keys([keys] if isinstance(keys, str) else keys)
    if len(found) != 1:
        raise ConfigurationError(f"ActionFlowTransform: {name}={keys!r}: expected one key")
    return found[0]


def _same(*states: Tensor) -> Tensor:
    """Return which of two states ``(*B, S)`` are the same ``(*B)``, up to rounding."""
    one, other = (state.float().nan_to_num() for state in states)
    return (one == other).all(-1)
