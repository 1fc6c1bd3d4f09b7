"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.compiling.machine_code import MachineCode, in_one_batch
from afm_rl.compiling.tracing import all_hold
from afm_rl.correction.base import Correction, put, rows_of
from afm_rl.correction.counterfactuals import draw_counterfactuals
from afm_rl.correction.hypotheses import HYPOTHESES, IDENTITY, check_hypotheses, memory_of
from afm_rl.correction.pairs import PairCorrector
from afm_rl.correction.tick import Tick
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_count, check_flag, check_number
from afm_rl.flow.experts import fit_experts
from afm_rl.flow.network import AxisNetwork
from afm_rl.flow.prior import Drawn
from afm_rl.flow.training import EFFECT_WEIGHT, States, flow_losses
from afm_rl.flow.weights import load_universal
from afm_rl.regimes import Regime

PLANS = 4  # for each window, in training
CORRECTED = ("executed", "predicted", "spread", "bounds", "misaligned")
ROWS = 12  # pairs that a hypothesis reads, at least


class ActionFlow(PairCorrector):
    r"""The flow from noise around the planned action to the action that has its effect.

    A regime is described by pairs (executed, effective action), which mean the same for every
    model and robot (:func:`~afm_rl.dynamics.inverse.effective_action`). One network, trained once
    on regimes without any robot (:mod:`~afm_rl.flow.prior`), answers for any number of actions.
    At every tick (:meth:`correct`):

    1. *Innovation and effective action*: what did the last transition show?
    2. *Gate*: while no innovation exceeds ``gate`` standard deviations of the model's noise, the
       planned action is executed.
    3. *Hypotheses*: the memory is read in several ways (:mod:`~afm_rl.correction.hypotheses`).
       Each predicts the next effect; the one with the smallest discounted loss
       :math:`L \leftarrow \lambda L + \rho(\hat T(u) - u_\mathrm{eff})`,
       :math:`\rho(x) = x^2 / (x^2 + 0.25^2)`, is believed. No correction at all is one of them.
       Pairs from before the gate opened are read by place only, and a hypothesis is forgiven its
       first guesses once a line explains all pairs that it has read.
    4. *Experts* fit its pairs, and the network encodes both.
    5. *Flow*: straight paths :math:`x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1` lead from
       around the plan :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)`.
    6. *Choice*: the sample, their mean, or the answer of an expert that explains all pairs, whose
       predicted effect is nearest to the achievable part of the plan is executed.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        hypotheses: names of :data:`~afm_rl.correction.hypotheses.HYPOTHESES`; all if None.
        rows: pairs that a hypothesis reads, K; None: 12, or more for more than eight actions.
        memory: pairs that are remembered, M.
        place: coordinates of the state in which the ground may differ; hypotheses by place are
            left out if there are none.
        place_scale: distance at which ground counts as other ground, in their unit.
        forgetting: :math:`\lambda`, of the hypotheses' losses.
        gate: in standard deviations of the model.
        samples: starting points of the flow.
        source_std: :math:`\sigma`, a share of the largest action.
        steps: midpoint steps.
        choose: the ``"best"`` sample by its predicted effect, or always their ``"mean"``.
        saturation: what gives way when a plan is not achievable in full, see
            :func:`~afm_rl.flow.saturation.saturate`.
        compile: run the tick as machine code, which is faster for a single
            mission; it is compiled once and kept in the cache. Where there is no compiler, the
            tick runs as it is. Results agree to rounding.
        cache: folder of compiled ticks.
        network: the network; None: the universal one that comes with the package.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(3):  # both motors are reversed
    ...     plan, box = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, found = flow.correct(memory, plan, Dubins(), box)
    ...     state = Dubins()(state, -found.executed)
    ...     memory = flow.observe(memory, state)
    >>> found.executed.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    _machine_code: MachineCode

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        hypotheses: Sequence[str] | None = None,
        rows: int | None = None,
        memory: int = 40,
        place: Sequence[int] = (),
        place_scale: float = 0.5,
        forgetting: float = 0.7,
        gate: float = 5.0,
        samples: int = 16,
        source_std: float = 0.3,
        steps: int = 1,
        choose: str = "best",
        saturation: str = "clip",
        compile: bool = False,
        cache: str | Path = "~/.cache/afm_rl",
        network: AxisNetwork | None = None,
    ) -> None:
        size = len(torch.as_tensor(action_low))
        rows = max(ROWS, size + 4) if rows is None else check_count("corrector.rows", rows)
        super().__init__(action_low, action_high, gate, rows, memory, len(list(place)))
        self.place = list(place)
        self.place_scale = check_number(
            "corrector.place_scale", place_scale, low=0.0, open_low=True
        )
        hypotheses = list(HYPOTHESES) if hypotheses is None else hypotheses
        self.hypotheses = check_hypotheses(hypotheses, by_place=bool(self.place))
        chosen = [HYPOTHESES[name] for name in self.hypotheses]
        if self.memory < memory_of(chosen, rows):
            raise ConfigurationError(
                f"corrector.memory={memory!r}: expected at least {memory_of(chosen, rows)} for "
                f"{rows} rows and the hypotheses {', '.join(self.hypotheses)}"
            )
        self.saturation = saturation
        self.compiles = check_flag("corrector.compile", compile)
        self.__dict__["_machine_code"] = MachineCode(self, cache)
        self.tick = Tick(
            load_universal() if network is None else network,
            self.scale,
            self.hypotheses,
            IDENTITY in hypotheses,
            rows,
            self.memory,
            forgetting,
            samples,
            source_std,
            steps,
            choose,
            saturation,
        )

    @property
    def network(self) -> AxisNetwork:
        """The network that answers."""
        return self.tick.network

    @property
    def _as_machine_code(self) -> bool:
        return self.compiles and not torch.compiler.is_compiling()

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the hypotheses' losses and predicted effects."""
        count = len(self.hypotheses) + 1  # the identity is the last
        return {
            **super().shapes(state_size),
            "losses": (count,),
            "forecasts": (count, self.action_size),
        }

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        with torch.no_grad():
            memory, innovation, idle = self._watch(memory, planned, model)
            surprised = innovation > self.gate
            found = self.unchanged(planned, innovation, box)
            if all_hold(~surprised):
                return idle, found
            use = rows_of(surprised)
            answer = self._answer(memory[use], planned[use], box[use])
            now = {"memory": idle, **found._asdict()}
            now = {name: put(now[name], surprised, use, part) for name, part in answer.items()}
            return now.pop("memory"), found._replace(**now)

    def decide(self, memory: Tensor, planned: Tensor, box: Tensor) -> tuple[Tensor, ...]:
        """Return the memories, and what to execute, of B missions whose model is misaligned.

        Args:
            memory: with the newest pair, ``(B, P)``.
            planned: ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.

        Returns:
            The next memory, and the first five parts of a correction but the innovation.
        """
        parts, kind = self.unpack(memory, self.states_in(memory)), self.tick.penalty.dtype
        given = [parts[name] for name in ("pairs", "losses", "forecasts", "misaligned")]
        given += [self.place_of(parts["state"]), planned, box]
        answer = self.tick(*(part.to(kind) for part in given))
        changed = {name: getattr(answer, name) for name in ("losses", "forecasts", "acting")}
        changed |= {"executed": answer.executed, "misaligned": torch.ones_like(memory[..., :1])}
        parts |= {"planned": planned, **{name: part.to(memory) for name, part in changed.items()}}
        return (self.pack(parts), *(getattr(answer, name) for name in CORRECTED))

    def watch(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> tuple[Tensor, ...]:
        """Return memory and innovation of :meth:`look`, and the memory if nothing is corrected.

        Args:
            memory: ``(*B, P)``.
            planned: ``(*B, A)``.
            model: as it is now.
        """
        memory, innovation = self.look(memory, model)
        idle = self.executing(memory, planned, planned, innovation > self.gate)
        return memory, innovation, idle

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory with forecasts moved by what was given more than sent."""
        parts = self.unpack(super().reported(memory, given), self.states_in(memory))
        more = self.normalise(given - self.latest(memory)[2])
        return self.pack({**parts, "forecasts": parts["forecasts"] + more.unsqueeze(-2)})

    def observe(self, memory: Tensor, next_state: Tensor) -> Tensor:
        """Return the memory with the transition to ``next_state`` ``(*B, S)``."""
        if not self._as_machine_code:
            return super().observe(memory, next_state)
        return self._machine_code(PairCorrector.observe, memory, next_state)[0]

    def _watch(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> Sequence[Tensor]:
        # Machine code holds the model as it is now, one round of Gauss and Newton, and no
        # automatic derivative.
        derived = type(model).jacobian is DynamicsModel.jacobian
        if not self._as_machine_code or not model.affine or model.taught_in is not None or derived:
            return self.watch(memory, planned, model)
        return self._machine_code(ActionFlow.watch, memory, planned, model=model)

    @torch.inference_mode()
    def _answer(self, *given: Tensor) -> dict[str, Tensor]:
        if self._as_machine_code:
            found = self._machine_code(ActionFlow.decide, *given)
        else:
            found = in_one_batch(self.decide, *given)
        return dict(zip(("memory", *CORRECTED), found, strict=True))

    def place_of(self, state: Tensor) -> Tensor:
        """Return where a state is, in the unit in which ground differs."""
        return state[..., self.place] / self.place_scale if self.place else state[..., :0]

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {"kind": "ActionFlow"}

    def training_loss(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: States,
        count: int,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the loss of ``count`` windows of a robot, see :func:`train_flow`."""
        drawn = self._draw(model, regime, states, count, generator)
        velocity, effect = flow_losses(self.network, drawn, self.saturation, generator)
        return (velocity + EFFECT_WEIGHT * effect).mean()

    @torch.no_grad()
    def held_out_error(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: States,
        count: int,
        generator: torch.Generator,
    ) -> float:
        """Return the RMS error of the action on new windows, a share of the largest one."""
        drawn = self._draw(model, regime, states, count, generator)
        known = self.network.encode(drawn.rows, fit_experts(drawn.rows))
        box = torch.stack([self.lowest, self.highest]).expand(count, -1, -1)
        sent = drawn.rows.executed
        tried, plans = sent.amax(-2) - sent.amin(-2), drawn.planned.unbind(1)
        found = [self.tick.propose(known, plan, box, tried)[0] for plan in plans]
        return float((torch.stack(found, 1) - drawn.intended).square().mean().sqrt())

    def _draw(self, model, regime, states, count, generator) -> Drawn:
        with torch.no_grad():
            size = (count, self.recent, PLANS)
            return draw_counterfactuals(
                self, model, regime, states, size, self.saturation, generator
            )
