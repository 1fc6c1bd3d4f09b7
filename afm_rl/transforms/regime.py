"""Regimes on any environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from afm_rl.errors import ConfigurationError, check_flag
from afm_rl.regimes import Regime, Schedule, phase_parameters, shifted
from afm_rl.streams import Streams
from afm_rl.transforms.stateful import StatefulTransform


class RegimeTransform(StatefulTransform):
    r"""Change the dynamics of any environment: it receives the effects of actions.

    .. math:: a_\mathrm{eff} = \mathrm{clip}(g(a_t;\, \rho_k,\, s_t))

    Put it first in a ``Compose``, next to the environment: what comes after it, such as
    :class:`~afm_rl.transforms.ActionFlowTransform`, does not know. Its memory lives in the
    tensordict, under ``prefix``, so every environment of a batch has its own, and resets,
    branches and resumed rollouts are exact. Of use to others are

    * ``(prefix, "parameters")``: what acts on the next action, ``(*B, F)``, for an oracle,
    * ``(prefix, "effective_action")``: what reached the environment,
    * ``(prefix, "step")``: steps since the reset, ``(*B)``. The schedule starts again with it.

    Args:
        regime: the family of regimes.
        phases: parameters of each phase by name, those not named being nominal; or rows
            ``(P, F)``, or ``(*B, P, F)`` for environments under regimes of their own.
        at: how many steps of an episode precede each further phase: with ``[100]`` the first
            100 actions are those of the first phase.
        clip: bring effective actions into the environment's action spec, as an actuator that
            cannot do more: twice the largest action is then still the largest. False hands
            them on as they are, to environments that know what to do with them.
        observation_key: the state in which actions act.
        action_key: the action.
        prefix: where the memory is kept.
        seed: of the noise, for random regimes.

    Raises:
        ConfigurationError: if phases and breakpoints do not fit each other or the regime, or
            the action is not a vector of real numbers.

    >>> from torchrl.envs import GymEnv, TransformedEnv
    >>> from afm_rl.regimes import ActionGain
    >>> reversal = RegimeTransform(ActionGain(["torque"]), [{}, {"torque": -1.0}], at=[3])
    >>> data = TransformedEnv(GymEnv("Pendulum-v1"), reversal).rollout(5)
    >>> (data["next", "regime", "effective_action"] / data["action"]).flatten().tolist()
    [1.0, 1.0, 1.0, -1.0, -1.0]
    """

    rows: Tensor

    def __init__(
        self,
        regime: Regime,
        phases: Sequence[Mapping[str, float]] | Tensor,
        at: Sequence[float] = (),
        clip: bool = True,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        prefix: NestedKey = "regime",
        seed: int = 0,
    ) -> None:
        super().__init__(observation_key, action_key, prefix)
        self.regime = regime
        self.schedule = Schedule(at, by="step")
        rows = phases if isinstance(phases, Tensor) else [regime.encode(row) for row in phases]
        rows = rows if isinstance(rows, Tensor) or not rows else torch.stack(rows)
        wanted = self.schedule.phases, len(regime.names)
        if not isinstance(rows, Tensor) or rows.shape[-2:] != wanted:
            given = f"rows {tuple(rows.shape)}" if isinstance(rows, Tensor) else list(phases)
            raise ConfigurationError(
                f"phases={given}: expected {wanted[0]}, one more than at={list(at)}, each with "
                f"values of {', '.join(regime.names)}"
            )
        self.register_buffer("rows", rows, persistent=False)
        self.clip = check_flag("clip", clip)
        self.streams = Streams(salt=5, seed=seed)

    def parameters_at(self, step: Tensor) -> Tensor:
        """Return the parameters ``(*B, F)`` that act after ``step`` ``(*B)`` steps."""
        phase = self.schedule.phase(step.to(self.rows.dtype), step + 1)
        return phase_parameters(self.rows.expand(*step.shape, *self.rows.shape[-2:]), phase)

    def act(self, tensordict: TensorDictBase, memory: TensorDictBase) -> TensorDictBase:
        """Replace the action by its effect."""
        memory, command = memory.clone(recurse=False), tensordict.get(self.action_key)
        parameters, state = memory.get("parameters"), memory.get("state")
        past, noise = memory.get("past", None), None
        if self.regime.noisy:
            noise = self.streams.normal(command.shape, device=command.device, dtype=command.dtype)
        effect = self.regime.apply(command, parameters, state, past, noise)
        if self.clip:
            effect = self.parent.full_action_spec[self.action_key].project(effect)
        if past is not None:
            memory.set("past", shifted(past, command))
        memory.set("effective_action", effect)
        return tensordict.set(self.prefix, memory).set(self.action_key, effect)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = tensordict.get(self.prefix).clone(recurse=False)
        step = memory.get("step") + 1
        memory.set("step", step)
        memory.set("state", next_tensordict.get(self.observation_key).clone())
        memory.set("parameters", self.parameters_at(step).to(memory.get("parameters")))
        return next_tensordict.set(self.prefix, memory)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        state, memory = tensordict_reset.get(self.observation_key), self.empty(tensordict_reset)
        parameters = self.parameters_at(memory.get("step"))
        memory.set("parameters", parameters.to(memory.get("parameters")))
        return tensordict_reset.set(self.prefix, memory.set("state", state.clone()))

    def memory_spec(self, spec: Composite) -> Composite:
        """Return the specs of the memory."""
        batch, (action, state) = spec.shape, self.specs()
        kind = action.dtype
        found = Composite(
            step=Unbounded(batch, dtype=torch.int64),
            state=Unbounded((*batch, *state.shape), dtype=state.dtype),
            parameters=Unbounded((*batch, len(self.regime.names)), dtype=kind),
            effective_action=Unbounded((*batch, *action.shape), dtype=kind),
            shape=batch,
        )
        if self.regime.history:
            size = *batch, self.regime.history, *action.shape
            found["past"] = Unbounded(size, dtype=kind)
        return found
