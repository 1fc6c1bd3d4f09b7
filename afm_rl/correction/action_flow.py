"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import torch
from torch import Tensor

from afm_rl.compiling.machine_code import MachineCode, in_one_batch
from afm_rl.compiling.tracing import all_hold, somewhere
from afm_rl.correction.base import Correction, Fields
from afm_rl.correction.belief import mean_and_std
from afm_rl.correction.core import LEAST_NOISE, Core
from afm_rl.correction.flow_options import FlowOptions
from afm_rl.correction.hypotheses import CHOICES, choose, delayed
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.options import filled, options


class ActionFlow(Core):
    r"""The flow from noise around the planned action to the action that has its effect.

    A regime is described by pairs (executed, effective action), which mean the same for every
    model and robot (:func:`~afm_rl.dynamics.inverse.effective_action`). One network, trained once
    on regimes without any robot (:mod:`~afm_rl.correction.training.prior`), answers for any number
    of actions. At every tick (:meth:`correct`):

    1. *Measure*: the last transition gives a pair (u, v) and how sure v is.
    2. *Believe*: the hypotheses (:mod:`~afm_rl.correction.hypotheses`) that predicted v well gain
       weight, axis by axis (:mod:`~afm_rl.correction.belief`); the noise that none explains is
       learnt. The first is that *nothing has changed*. No loss is negative, so while its own is
       below its ``odds`` no other one can outweigh it: the planned action is executed, and nothing
       more is computed. When it is exceeded, the pairs from before are marked as old.
    3. *Flow*: straight paths :math:`x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1` lead from
       around the plan :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)`.
    4. *Act*: of the plan, the flow's samples and the exact inverses of the fits, the action with
       the least expected loss under the belief is executed.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        network: the network; None: the universal one that comes with the package.

    Raises:
        ConfigurationError: for unknown hypotheses, ``noise`` below .02, or a ``memory``
            that is shorter than hypotheses look back.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(8):  # both motors are reversed
    ...     plan, box = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, correction = flow.correct(memory, plan, Dubins(), box)
    ...     state = Dubins()(state, -correction.executed)
    ...     memory = flow.observe(memory, state)
    >>> correction.executed.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    _machine_code: MachineCode
    cause: Tensor
    episodic = (*Core.episodic, "under_way", "unmet")

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        network: AxisNetwork | None = None,
        **options: Unpack[FlowOptions],
    ) -> None:
        settings: FlowOptions = filled(FlowOptions, "corrector", options)
        size = len(torch.as_tensor(action_low))
        rows = max(12, size + 4) if settings["rows"] is None else settings["rows"]
        names, place = settings["hypotheses"], bool(settings["place"])
        hypotheses = choose(names, place, settings["plain"], settings["longest_delay"])
        network = load_universal() if network is None else network
        super().__init__(action_low, action_high, network, hypotheses, rows, settings)
        self.noise = check_number("corrector.noise", settings["noise"], low=LEAST_NOISE)
        longest = rows + self.acting.shape[-1] - 1
        if self.memory < longest:
            raise ConfigurationError(
                f"corrector.memory={settings['memory']!r}: expected at least {longest} for {rows} "
                f"rows and the hypotheses "
                f"{', '.join(row.name for row in hypotheses if row.name in CHOICES)}"
            )
        self.models = tuple(row.name for row in self.hypotheses)
        causes = [
            delayed(row.delay + self.delay) if row.delay else row.cause for row in self.hypotheses
        ]
        in_words = [delayed(k + self.delay) for k in range(1, self.longest_delay + 1)]
        self.causes = tuple(dict.fromkeys([causes[0], *in_words, *causes]))
        cause = torch.tensor([self.causes.index(cause) for cause in causes])
        self.register_buffer("cause", cause, persistent=False)
        self.compiles = settings["compile"]
        self.__dict__["_machine_code"] = MachineCode(self, settings["cache"])

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {"kind": "ActionFlow"}

    def belief_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``.

        Of a memory ``(*B, P)``. A model that follows the believed delay counts as that delay.

        >>> flow = ActionFlow(-torch.ones(1), torch.ones(1))
        >>> belief = flow.belief_in(flow.begin(torch.zeros(2)))
        >>> flow.causes[0], belief[0].item() > 0.7, belief.sum(-2).round(decimals=4)
        ('nothing has changed', True, tensor([1.]))
        """
        delay = self.unpack(memory, self.states_in(memory))["delay"].long()
        cause = torch.where((self.delays < 0) & (delay > 0), delay, self.cause)
        weights = self.weights_in(memory)
        none = weights.new_zeros(*weights.shape[:-2], len(self.causes), self.action_size)
        return none.scatter_add(-2, cause.unsqueeze(-1).expand_as(weights), weights)

    def cause_in(self, memory: Tensor) -> str:
        """Return the likeliest change that memories ``(*B, P)`` show, in words."""
        belief = self.belief_in(memory).movedim(-2, -1).flatten(0, -2).mean(0)
        cause = self.causes[1 + int(belief[1:].argmax())]
        if cause == "a recent change":
            return super().cause_in(memory)
        return cause + (": a delay that the model lacks?" if "late" in cause else "")

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the belief; its noise is the last part."""
        size, count = self.action_size, len(self.models)
        belief = {"losses": (count, size), "forecasts": (count, size), "noise": (size,)}
        # One row at least: no exported branch may return an empty tensor.
        waiting = max(1, self.longest_delay + self.delay)
        delay = {"delay": (1,), "under_way": (waiting, size), "unmet": (size,)}
        return {**super().shapes(state_size), "corrects": (1,), "usual": (1,), **delay, **belief}

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin in ``state`` ``(*B, S)``."""
        parts = self.unpack(super().begin(state), state.shape[-1])
        return self.pack({**parts, "noise": torch.full_like(parts["noise"], self.noise)})

    def detect(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> tuple[Tensor, ...]:
        """Return the memory with the newest pair, and what it is if the plan is executed.

        Returns:
            Both, may the action have to be corrected? ``(*B)``, and the innovation ``(*B)``.
        """
        fields = self.unpack(memory, model.state_size)
        fields, changed = self.believe(fields, self.ask(fields, model))
        innovation = fields["pairs"][..., -1, -self.tail]
        idle = fields if all_hold(changed) else self.as_planned(fields, planned)
        return self.pack(fields), self.pack(idle), changed, innovation

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        inside = planned.clamp(*box.unbind(-2))
        with torch.no_grad():
            memory, idle, misaligned, innovation = self._detect(memory, inside, model)
            plan = self.unchanged(inside, innovation, box)._replace(noise=self.noise_in(memory))
            as_planned = [idle, *plan[:4], plan.misaligned]
            decided = somewhere(misaligned, self._decide, as_planned, memory, planned, box)
            memory, executed, predicted, spread, bounds, corrects = decided
            answer = {"executed": executed, "predicted": predicted, "spread": spread}
            return memory, plan._replace(**answer, bounds=bounds, misaligned=corrects)

    def under_way(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state, the newest commands' effects, and how many of them are to come."""
        fields = self.unpack(memory, self.states_in(memory))
        steps = fields["delay"].squeeze(-1).long() + self.delay
        effects = fields["under_way"][..., : self.longest_delay + self.delay, :]
        return fields["state"], self.denormalise(effects), steps

    def noise_in(self, memory: Tensor) -> Tensor:
        """Return the noise that was learnt, ``(*B, A)``, in units of the action."""
        return self.scale * memory[..., -self.action_size :]

    def weights_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`models` are, by axis, ``(*B, H, A)``."""
        return self.weights(self.unpack(memory, self.states_in(memory)))

    @torch.no_grad()
    def predict(
        self, memory: Tensor, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        """Return the effect that an action ``(*B, A)`` will have, and its standard deviation.

        Both in units of the action, ``(*B, A)``: what the model would have to be given, so that it
        expects what the robot will do. With a delay it is what acts now, of earlier commands.

        Args:
            memory: up to the present state, ``(*B, P)``; it is not changed.
            action: what would be executed.
            model: the dynamics model as it is now.
        """
        fields = self.unpack(memory, model.state_size)
        fields, _ = self.believe(fields, self.ask(fields, model))
        fields = self.foreseen(fields, action)
        mean, std = mean_and_std(fields["forecasts"], self.weights(fields))
        return self.denormalise(mean), self.scale * torch.hypot(std, fields["noise"])

    @torch.no_grad()
    def executing(
        self, memory: Tensor, planned: Tensor, executed: Tensor, misaligned: Tensor | None = None
    ) -> Tensor:
        """Return the memory with the actions that are planned and executed now, ``(*B, A)``."""
        memory = super().executing(memory, planned, executed, misaligned)
        return self.pack(self.foreseen(self.unpack(memory, self.states_in(memory)), executed))

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory with forecasts moved by what was given more than sent."""
        _, _, sent = self.latest(memory)
        fields = self.unpack(super().reported(memory, given), self.states_in(memory))
        if self.delay:
            sent = self.unpack(memory, self.states_in(memory))["sent"][..., 0, :]
        more = ((given - sent) / self.scale).unsqueeze(-2)
        return self.pack({**fields, "forecasts": fields["forecasts"] + more})

    def foreseen(self, fields: Fields, executed: Tensor) -> Fields:
        """Return the fields with forecasts of what is executed, of all models if misaligned."""
        idle = self.as_planned(fields, executed)
        unchanged = [idle["forecasts"], idle["under_way"]]
        misaligned = fields["misaligned"].squeeze(-1) == 1.0
        work = [self.pack(fields), executed]
        forecasts, under_way = somewhere(misaligned, self._forecast, unchanged, *work)
        return fields | {"forecasts": forecasts, "under_way": under_way}

    def _forecast(self, memory: Tensor, executed: Tensor) -> Sequence[Tensor]:
        """Return the forecasts of all models, and what is under way, of memories ``(*B, P)``."""

        def in_batch(memory: Tensor, executed: Tensor) -> tuple[Tensor, Tensor]:
            fields = self.unpack(memory, self.states_in(memory))
            weights = self.weights(fields).to(self.points)
            return self.forecast(fields, self.fit(fields), weights, executed)

        return in_one_batch(in_batch, memory, executed)

    @property
    def _as_machine_code(self) -> bool:
        return self.compiles and not torch.compiler.is_compiling()

    def observe(self, memory: Tensor, next_state: Tensor) -> Tensor:
        """Return the memory with the transition to ``next_state`` ``(*B, S)``."""
        if not self._as_machine_code:
            return super().observe(memory, next_state)
        return self._machine_code(Core.observe, memory, next_state)[0]

    def _detect(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> Sequence[Tensor]:
        # Machine code holds the model as it is now, one round of Gauss and Newton, and no
        # automatic derivative.
        derived = type(model).jacobian is DynamicsModel.jacobian
        if not self._as_machine_code or not model.affine or model.taught_in is not None or derived:
            return self.detect(memory, planned, model)
        return self._machine_code(ActionFlow.detect, memory, planned, model=model)

    @torch.inference_mode()
    def _decide(self, *arguments: Tensor) -> Sequence[Tensor]:
        if self._as_machine_code:
            return self._machine_code(Core.decide, *arguments)
        return in_one_batch(self.decide, *arguments)
