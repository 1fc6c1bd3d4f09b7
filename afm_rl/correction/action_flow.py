"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

import os
from typing import Any, Unpack, get_args

import torch
from torch import Tensor

from afm_rl.compiling.tracing import may_look
from afm_rl.correction.base import Correction, Corrector, Fields
from afm_rl.correction.belief import mean_and_std
from afm_rl.correction.core import LEAST_NOISE, Core, Plan, Tick
from afm_rl.correction.flow_options import FASTER, SIZES, Code, FlowOptions
from afm_rl.correction.hypotheses import CHOICES, choose, delayed
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_number
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
        own, network = network, load_universal() if network is None else network
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
        self.code = settings["core"]
        _environment()
        self.usual_options = is_usual(settings)
        self.usual = self.usual_options and own is None
        self.register_load_state_dict_post_hook(_look_at_weights)
        if self.code == "c" and not (self.usual and size in SIZES):
            raise ConfigurationError(
                f"corrector.core='c': expected default options and one of {SIZES} actuators, for "
                f"which there are graphs; here are {size}; or set it to 'auto'"
            )

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

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin in ``state`` ``(*B, S)``."""
        parts = self.unpack(super().begin(state), state.shape[-1])
        return self.pack({**parts, "noise": torch.full_like(parts["noise"], self.noise)})

    @torch.no_grad()
    def correct(
        self,
        memory: Tensor,
        planned: Tensor,
        model: DynamicsModel,
        box: Tensor,
        limits: Tensor | None = None,
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        fields = self.unpack(memory, model.state_size)
        measured = self.measure(fields, model)
        asked = Plan(planned, box, limits)
        units = (None if numbers is None else self.normalise(numbers) for numbers in asked[:3])
        plan = Plan._make([*units, *self.surroundings(fields)])
        tick = self._tick(self.core_of(memory), measured, plan)
        # Where nothing is corrected it is the plan, to the bit.
        inside, on = asked.inside, tick.corrects.unsqueeze(-1)
        executed, predicted = (
            torch.where(on, self.denormalise(unit), inside)
            for unit in (tick.command, tick.predicted)
        )
        bounds = torch.where(on.unsqueeze(-1), self.denormalise(tick.bounds), box)
        memory = self.with_core(memory, tick.memory)
        memory = Corrector.executing(self, memory, inside, executed, tick.corrects)
        spread, noise = self.scale * tick.spread, self.noise_in(memory)
        # Of the newest pair, zero where it does not count.
        innovation = tick.memory[..., self.memory * self.pair_size - self.tail]
        of_step = spread, bounds, innovation, tick.corrects, noise
        return memory, Correction(executed, predicted, *of_step)

    def _tick(self, memory: Tensor, measured: Tensor, plan: Plan) -> Tick:
        """Return the core's answer, by its C code if that is there and this can be asked."""
        choice = self.code if self.code != "auto" else _environment()
        asks = choice == "c" or choice == "auto" and self.action_size <= FASTER
        if not asks or not self.usual or measured.shape[-2] > 1 or not may_look(memory):
            return self.forward(memory, measured, plan)
        from afm_rl.correction.in_c import core_in_c

        limits = plan.box if plan.limits is None else plan.limits
        given = memory, measured.squeeze(-2), plan.action, plan.box, limits
        in_c = core_in_c(self.action_size)
        tick = in_c.tick(*given, wait=choice == "c")
        if tick is None and choice == "c":
            raise ConfigurationError(f"corrector.core='c': {in_c.reason}; or set it to 'auto'")
        return self.forward(memory, measured, plan) if tick is None else tick

    def core_of(self, memory: Tensor) -> Tensor:
        """Return the part of a memory ``(*B, P)`` that the core knows."""
        return memory[..., -sum(self.learnt.sizes) :]

    def with_core(self, memory: Tensor, core: Tensor) -> Tensor:
        """Return the memory with another part of the core."""
        return torch.cat([memory[..., : -core.shape[-1]], core], -1)

    def surroundings(self, fields: Fields) -> tuple[Tensor | None, Tensor | None]:
        """Return the commands that are known to act later, and the place; None where there is none.

        ``(*B, D, A)`` in shares of the largest action, and ``(*B, G)``.
        """
        waiting = self.normalise(fields["sent"]) if self.delay else None
        return waiting, self.place_of(fields["state"]) if self.place else None

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
    def follow(self, memory: Tensor, action: Tensor, model: DynamicsModel) -> Tensor:
        """Return the memory ``(*B, P)`` if somebody else executes ``action`` ``(*B, A)`` now.

        Args:
            memory: up to the present state.
            action: what is executed instead of a correction.
            model: the dynamics model as it is now.
        """
        fields = self.unpack(memory, model.state_size)
        believed, _ = self.believe(fields, self.measure(fields, model))
        foreseen = self.foreseen(believed, self.normalise(action), *self.surroundings(fields))
        memory = self.with_core(memory, self.learnt.pack(foreseen))
        return Corrector.executing(self, memory, action, action)

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
        return self.expected_in(self.follow(memory, action, model))

    def expected_in(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the effect that is expected now, and its standard deviation, ``(*B, A)``."""
        fields = self.unpack(memory, self.states_in(memory))
        mean, std = mean_and_std(fields["forecasts"], self.weights(fields))
        return self.denormalise(mean), self.scale * torch.hypot(std, fields["noise"])

    @torch.no_grad()
    def executing(
        self, memory: Tensor, planned: Tensor, executed: Tensor, misaligned: Tensor | None = None
    ) -> Tensor:
        """Return the memory with the actions that are planned and executed now, ``(*B, A)``."""
        memory = super().executing(memory, planned, executed, misaligned)
        fields = self.unpack(memory, self.states_in(memory))
        foreseen = self.foreseen(fields, self.normalise(executed), *self.surroundings(fields))
        later = {name: foreseen[name] for name in ("forecasts", "under_way")}
        return self.with_core(memory, self.learnt.pack(fields | later))

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory with forecasts moved by what was given more than sent."""
        _, _, sent = self.latest(memory)
        fields = self.unpack(super().reported(memory, given), self.states_in(memory))
        if self.delay:
            sent = self.unpack(memory, self.states_in(memory))["sent"][..., 0, :]
        more = ((given - sent) / self.scale).unsqueeze(-2)
        return self.pack({**fields, "forecasts": fields["forecasts"] + more})


def is_usual(settings: FlowOptions) -> bool:
    """Return whether options are those for which there are graphs: the default ones."""
    usual = filled(FlowOptions, "corrector", {})
    names = usual.keys() - {"home", "noise", "core"}  # which the core does not know
    return all(settings[name] == usual[name] for name in names)  # type: ignore[literal-required]


def _look_at_weights(flow: ActionFlow, _: Any) -> None:
    """Note whether the weights that were loaded are the universal ones."""
    stored, loaded = load_universal().state_dict(), flow.network.state_dict()
    alike = stored.keys() == loaded.keys()
    alike = alike and all(torch.equal(stored[k], loaded[k].cpu().to(stored[k])) for k in stored)
    flow.usual = flow.usual_options and alike


def _environment() -> str:
    """Return how correctors are computed that leave it open."""
    return check_choice("AFM_RL_CORE", os.environ.get("AFM_RL_CORE", "auto"), get_args(Code))
