"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from afm_rl.compiling.machine_code import MachineCode, in_one_batch
from afm_rl.correction.base import Fields
from afm_rl.correction.believing import Answer, Believer
from afm_rl.correction.late import LATE, NOW, Late, acting_of
from afm_rl.correction.linear import CALM, LINEAR, MIXING
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.correction.pairs import PairCorrector
from afm_rl.correction.readings import READINGS, cause_of, check_readings
from afm_rl.correction.tick import Tick
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_count, check_flag, check_number


class ActionFlow(Believer):
    r"""The flow from noise around the planned action to the action that has its effect.

    A regime is described by pairs (executed, effective action), which mean the same for every
    model and robot (:func:`~afm_rl.dynamics.inverse.effective_action`). One network, trained once
    on regimes without any robot (:mod:`~afm_rl.correction.training.prior`), answers for any number
    of actions. At every tick (:meth:`correct`):

    1. *Measure*: the last transition gives a pair (u, v) and how sure v is.
    2. *Believe*: the models that predicted v well gain weight, axis by axis
       (:mod:`~afm_rl.correction.belief`). That nothing has changed is one of them; the others are
       ways to read the memory (:mod:`~afm_rl.correction.readings`) with the network, or a plain
       least-squares fit, to answer. The noise that nothing explains is learnt.
    3. *Flow*: straight paths :math:`x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1` lead from
       around the plan :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)`.
    4. *Act*: of the plan, the flow's samples and the exact inverses of the fits, the action with
       the least expected squared miss under the belief is executed.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        readings: names of :data:`~afm_rl.correction.readings.READINGS`; all if None.
        rows: pairs of a reading, K; None: 12, or more for more than eight actions.
        memory: pairs that are remembered.
        place: coordinates of the state in which the ground may differ; readings by place are
            left out if there are none.
        place_scale: distance at which ground counts as other ground, in their unit.
        plain: prior log-odds of a linear model that is fitted against a reading: a line that
            predicts what is done now knows nothing of other actions.
        samples: starting points of the flow.
        source_std: :math:`\sigma`, a share of the largest action.
        steps: midpoint steps.
        saturation: what gives way when a plan is not achievable in full, see
            :func:`~afm_rl.correction.achievable.saturate`.
        compile: run the tick as machine code, which is faster for a single
            mission; it is compiled once and kept in the cache. Where there is no compiler, the
            tick runs as it is. Results agree to rounding.
        cache: folder of compiled ticks.
        network: the network; None: the universal one that comes with the package.
        rules: of the belief, see :class:`~afm_rl.correction.Believer`.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(8):  # both motors are reversed
    ...     plan, box = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, found = flow.correct(memory, plan, Dubins(), box)
    ...     state = Dubins()(state, -found.executed)
    ...     memory = flow.observe(memory, state)
    >>> found.executed.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    _machine_code: MachineCode
    cause: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        readings: Sequence[str] | None = None,
        rows: int | None = None,
        memory: int = 80,
        place: Sequence[int] = (),
        place_scale: float = 0.5,
        plain: float = -6.0,
        samples: int = 16,
        source_std: float = 0.3,
        steps: int = 1,
        saturation: str = "mixed",
        compile: bool = False,
        cache: str | Path = "~/.cache/afm_rl",
        network: AxisNetwork | None = None,
        **rules: Any,
    ) -> None:
        size, place = len(torch.as_tensor(action_low)), list(place)
        rows = max(12, size + 4) if rows is None else check_count("corrector.rows", rows)
        every = [*READINGS, *LATE] if readings is None else readings
        names, late = check_readings(every, bool(place))
        only = [f"only {name}" for name in late]
        models = [*names, *LINEAR, *only, NOW, *late, *CALM]
        # What says what every action does is worth more than a line through what is done now; and
        # late commands with some gain are one model, which the ways to be late share.
        worths = dict.fromkeys((*LINEAR, NOW), plain) | dict.fromkeys(("reversed", *MIXING), 0.0)
        worths |= dict.fromkeys(late, -math.log(max(1, len(late))))
        worth = [worths.get(name, 0.0) for name in models]
        acting = acting_of([LATE.get(name.removeprefix("only "), Late()) for name in ["", *models]])
        follows = [False, *(name not in {NOW, *MIXING, *late, *only} for name in models)]
        longest = rows + acting.shape[-1] - 1
        super().__init__(
            action_low,
            action_high,
            recent=rows,
            memory=memory,
            models=models,
            place=len(place),
            worth=worth,
            acting=acting,
            follows=follows,
            **rules,
        )
        self.readings, self.place = [*names, *late], place
        self.place_scale = check_number(
            "corrector.place_scale", place_scale, low=0.0, open_low=True
        )
        if self.memory < longest:
            raise ConfigurationError(
                f"corrector.memory={memory!r}: expected at least {longest} for {rows} rows and the "
                f"readings {', '.join(self.readings)}"
            )
        by_model = [cause_of(name, self.delay) for name in self.models]
        late_by = [cause_of(f"delay_{k}", self.delay) for k in range(1, self.most_late + 1)]
        self.causes = tuple(dict.fromkeys([by_model[0], *late_by, *by_model]))
        cause = torch.tensor([self.causes.index(name) for name in by_model])
        self.register_buffer("cause", cause, persistent=False)
        self.compiles = check_flag("corrector.compile", compile)
        self.__dict__["_machine_code"] = MachineCode(self, cache)
        network = load_universal() if network is None else network
        self.tick = Tick(
            network,
            self.scale,
            names,
            rows,
            self.delays,
            self.acting,
            acting_of([Late(), *(LATE[name] for name in late)]),
            samples,
            source_std,
            steps,
            saturation,
        )

    @property
    def network(self) -> AxisNetwork:
        """The network that answers."""
        return self.tick.network

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {"kind": "ActionFlow"}

    def belief_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``.

        Of a memory ``(*B, P)``. What takes any delay that is believed counts as late.

        >>> flow = ActionFlow(-torch.ones(1), torch.ones(1))
        >>> belief = flow.belief_in(flow.begin(torch.zeros(2)))
        >>> flow.causes[0], belief[0].item() > 0.7, belief.sum(-2).round(decimals=4)
        ('nothing has changed', True, tensor([1.]))
        """
        late = self.unpack(memory, self.states_in(memory))["late"].long()
        cause = torch.where((self.delays < 0) & (late > 0), late, self.cause)
        found = self.believed(memory)
        none = found.new_zeros(*found.shape[:-2], len(self.causes), self.action_size)
        return none.scatter_add(-2, cause.unsqueeze(-1).expand_as(found), found)

    def cause_in(self, memory: Tensor) -> str:
        """Return the likeliest change that memories ``(*B, P)`` show, in words."""
        belief = self.belief_in(memory).movedim(-2, -1).flatten(0, -2).mean(0)
        cause = self.causes[1 + int(belief[1:].argmax())]
        if cause == "a recent change":
            return super().cause_in(memory)
        return cause + (": a delay that the model lacks?" if "late" in cause else "")

    def place_of(self, state: Tensor) -> Tensor:
        """Return where a state is, in the unit in which ground differs."""
        return state[..., self.place] / self.place_scale if self.place else state[..., :0]

    def answer(self, parts: Fields, weights: Tensor, planned: Tensor, box: Tensor) -> Answer:
        """Ask the :class:`~afm_rl.correction.tick.Tick`."""
        late, sent = parts["late"].squeeze(-1).long(), self.normalise(parts["sent"])
        rest = (x.to(self.tick.scale) for x in (sent, planned, box))
        return self.tick(*self._read(parts, weights), late, *rest)

    def foresee(self, parts: Fields, executed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forecasts of all models, and what is under way."""
        ahead = torch.cat([parts["sent"], executed.unsqueeze(-2)], -2)
        given = *self._read(parts, self.weights(parts)), self.normalise(ahead)
        lead, late = executed.shape[:-1], parts["late"].reshape(-1).long()
        count = math.prod(lead)
        pairs, weights, noise, place, unit = (
            x.reshape(count, *x.shape[len(lead) :]) for x in given
        )
        read = self.tick.read(pairs, noise, place, late)
        found = self.tick.forecast(read, weights, late, pairs, unit.to(pairs))
        forecasts, under_way = (x.view(*lead, *x.shape[1:]).to(executed) for x in found)
        return forecasts, under_way

    def _read(self, parts: Fields, weights: Tensor) -> list[Tensor]:
        given = parts["pairs"], weights, parts["noise"], self.place_of(parts["state"])
        return [part.to(self.tick.scale) for part in given]

    @property
    def _as_machine_code(self) -> bool:
        return self.compiles and not torch.compiler.is_compiling()

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
    def _decide(self, *given: Tensor) -> Sequence[Tensor]:
        if self._as_machine_code:
            return self._machine_code(ActionFlow.decide, *given)
        return in_one_batch(self.decide, *given)
