"""The first healthy steps of each robot are collected; then its model is fitted, once."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction import Corrector
from afm_rl.diagnosis.suspect import LONGEST, FaultTable, floor_of, likely_fault
from afm_rl.dynamics import DynamicsModel, UnknownDynamics
from afm_rl.dynamics.linear_residual import PARTS, LinearResidual
from afm_rl.errors import ConfigurationError, warn
from afm_rl.learning.residual_fit import relevant_coordinates, residual_parts

AGAIN = 50  # steps until steps that look like a fault are looked at again
EVALUATIONS = 24  # of the model at a step, for the guard: what takes time is spread over the steps
PROBED = 8  # coordinates a step, of which is looked whether the motion depends on them
SAMPLES = 12  # of each fault in the window, at least


class ResidualState(NamedTuple):
    """What is known of the fit of each robot."""

    steps: Any
    """Valid steps up to now, ``(*B)``."""
    explained: Any
    """Share of the squared misses that the fit explains, ``(*B, D)``; 0 before it."""
    suspect: Any
    """Which fault the newest window looked like, in words; empty if none."""
    since: Any
    """The step at which the model was fitted, ``(*B)``; -1 before."""


class ResidualSteps(nn.Module):
    """Fits the model of each robot of a batch ``(*B)`` to its first steps, once, behind a guard.

    When ``steps`` valid steps of a robot are there, the guard of
    :func:`~afm_rl.diagnosis.suspect.likely_fault` looks at them. If they do not look like a fault,
    the model is fitted to them and stays as it is; else the newest ``steps`` are looked at again 50
    steps later. The guard's predictions are spread over the steps, so each fault is compared at
    every step of the window, or at every n-th one if there are many actuators.

    Args:
        model: the model that is fitted, in place.
        steps: of the window.
        delay: known steps from an action to its effect.
        largest: sizes of the largest actions, ``(A,)``.
    """

    model: LinearResidual

    def __init__(self, model: LinearResidual, steps: int, delay: int, largest: Tensor) -> None:
        super().__init__()
        self.__dict__["model"] = model  # shared: no part of the state dict
        self.steps, self.delay, self.time = steps, delay, 0
        self.warned = False
        self.table = FaultTable.of(largest.double(), model.home)
        faults = len(self.table.words) - 1
        self.every = min(math.ceil(faults / EVALUATIONS), max(1, steps // SAMPLES))
        self.seen: dict[str, Tensor] = {}

    @classmethod
    def of(
        cls, owner: str, model: DynamicsModel, steps: int, corrector: Corrector
    ) -> ResidualSteps:
        """Return the fit of a nominal model, to steps that a corrector sees.

        Raises:
            ConfigurationError: for a model to which no residual can be added, naming its owner.
        """
        if isinstance(model, UnknownDynamics):
            raise ConfigurationError(
                f"{owner}.residual_steps={steps}: there is no nominal model yet to which a "
                "residual could be added; leave it out with model='learn'"
            )
        if isinstance(model, LinearResidual):
            raise ConfigurationError(
                f"{owner}.residual_steps={steps}: the model was fitted before; leave "
                "residual_steps out, or give the nominal model, model.model"
            )
        largest = (corrector.home.abs() + corrector.scale).detach()
        return cls(LinearResidual(model), steps, corrector.delay, largest)

    def begin(self, state: Tensor) -> None:
        """Make room for robots in states ``(*B, S)``.

        Raises:
            ConfigurationError: for another number of robots than before.
        """
        batch, sizes = state.shape[:-1], (self.model.state_size, self.model.action_size)
        if self.seen:
            if self.seen["since"].shape != batch:
                raise ConfigurationError(
                    f"residual_steps: made for {tuple(self.seen['since'].shape)} robots, got "
                    f"{tuple(batch)}: each has a residual of its own; make another wrapper, "
                    "transform or policy for other robots"
                )
            return
        self.model.expand_to_(batch)
        nothing = torch.full((1,), torch.nan, device=state.device, dtype=torch.float64)
        motion, faults = self.model.manifold.tangent_size, len(self.table.words)
        whole = torch.zeros(batch, dtype=torch.long, device=state.device)
        self.seen = {
            "rows": nothing.expand(*batch, self.steps, 3 * sizes[0]).clone(),
            "errors": nothing.float().expand(*batch, self.steps, faults, motion).clone(),
            "sent": nothing.expand(*batch, self.delay + LONGEST + 1, sizes[1]).clone(),
            "last": nothing.expand(*batch, sizes[0]).clone(),
            "relevant": whole.unsqueeze(-1).expand(*batch, sizes[0]).bool().clone(),
            "count": whole,
            "since": whole - 1,
            "suspect": whole,
        }

    @property
    def fitted(self) -> Tensor:
        """Which robots have a fitted model, ``(*B)``."""
        return self.seen["since"] >= 0

    @torch.no_grad()
    def add(self, state: Tensor, action: Tensor, after: Tensor) -> Tensor | None:
        """Add a step of each robot; return which models are fitted now, ``(*B)``; None: none.

        Args:
            state, after: ``(*B, S)``; a step with a number that is not finite does not count.
            action: what was executed, ``(*B, A)``.
        """
        if not self.seen or bool(self.fitted.all()):
            return None
        seen, space = self.seen, self.model.manifold
        state, action, after = state.double(), action.double(), after.double()
        follows = (state == seen["last"]).all(-1)[..., None, None]
        before = seen["sent"][..., :-1, :].where(follows, torch.nan)
        seen["sent"] = torch.cat([action.unsqueeze(-2), before], -2)
        seen["last"] = after
        sent = seen["sent"][..., self.delay :, :]
        valid = torch.cat([state, sent[..., 0, :], after], -1).isfinite().all(-1) & ~self.fitted
        if not bool(valid.any()):
            return None

        # The guard's part of this step: no fault, and every n-th of the faults.
        turn = self.time % self.every
        rows = [0, *range(1 + turn, len(self.table.words), self.every)]
        predicted = self._predicted(rows, state, sent)
        missed = space.difference(after.unsqueeze(-2).expand_as(predicted), predicted)
        errors = torch.full_like(seen["errors"][..., 0, :, :], torch.nan)
        errors[..., rows, :] = missed.square().float()
        self._probe(state, sent[..., 0, :], valid)
        self.time += 1

        # In a ring, whose next place is count % steps.
        newest = torch.cat([state, predicted[..., 0, :], after], -1)
        robots = valid.reshape(-1).nonzero().squeeze(-1)
        places = (seen["count"] % self.steps).reshape(-1)[robots]
        for name, new in (("rows", newest), ("errors", errors)):
            shape = seen[name].shape[valid.dim() :]
            seen[name].view(-1, *shape)[robots, places] = new.reshape(-1, *shape[1:])[robots]
        seen["count"] = seen["count"] + valid
        due = valid & (seen["count"] >= self.steps)
        due &= (seen["count"] - self.steps) % AGAIN == 0
        return self._decide(due) if bool(due.any()) else None

    def _predicted(self, rows: list[int], state: Tensor, sent: Tensor) -> Tensor:
        """Return the nominal model's predictions under some faults, ``(*B, H, S)``."""
        nominal = self.model.model
        kind = torch.float64 if nominal.stiff else torch.get_default_dtype()
        table = self.table.part(rows)
        table = table._replace(
            matrix=table.matrix.to(kind), offset=table.offset.to(kind), home=table.home.to(kind)
        )
        return table.predicted(nominal, state.to(kind), sent.to(kind)).double()

    def _probe(self, state: Tensor, action: Tensor, valid: Tensor) -> None:
        """Look on some coordinates whether the motion depends on them."""
        nominal, size = self.model.model, state.shape[-1]
        kind = torch.float64 if nominal.stiff else torch.get_default_dtype()
        chosen = [(self.time * PROBED + k) % size for k in range(min(PROBED, size))]
        pair = state.unsqueeze(-2).to(kind), action.unsqueeze(-2).to(kind).nan_to_num()
        found = relevant_coordinates(nominal, *pair, coordinates=chosen)
        self.seen["relevant"] |= found & valid.unsqueeze(-1)

    def _decide(self, due: Tensor) -> Tensor | None:
        """Fit the models of robots that are ``due`` ``(*B)``, if the guard finds no fault."""
        seen, size, space = self.seen, self.model.state_size, self.model.manifold
        # The ring in the order of time.
        order = torch.arange(self.steps, device=due.device) + seen["count"][due].unsqueeze(-1)
        order = (order % self.steps).unsqueeze(-1)
        rows = seen["rows"][due].take_along_dim(order, 1)
        errors = seen["errors"][due].take_along_dim(order.unsqueeze(-1), 1)
        state, predicted, after = rows.split(size, -1)
        cause = likely_fault(errors, floor_of(space, state, after).to(errors))
        seen["suspect"] = seen["suspect"].masked_scatter(due, cause)
        if bool(cause.any()) and not self.warned:
            self.warned = True
            words = self.table.words[int(cause[cause > 0][0])]
            warn(
                f"residual_steps: not adjusted: these {self.steps} steps look like {words}; they "
                f"are looked at again every {AGAIN} steps"
            )
        well = cause == 0
        if not bool(well.any()):
            return None
        now = due.masked_scatter(due, well)
        kept = state[well], predicted[well], after[well], seen["relevant"][now]
        parts = residual_parts(space, *kept)
        for name, new in parts.items():
            whole = self.model.get_buffer(name).clone()
            whole[now] = new.to(whole)
            parts[name] = whole
        self.model.fitted_(**parts)
        seen["since"] = torch.where(now, seen["count"], seen["since"])
        return now

    @property
    def report(self) -> ResidualState | None:
        """What is known of the fits; None before the first reset."""
        if not self.seen:
            return None
        words = self.seen["suspect"].tolist()
        words = self.table.words[words] if isinstance(words, int) else _named(words, self.table)
        return ResidualState(self.seen["count"], self.model.explained, words, self.seen["since"])

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return steps and fits by name."""
        parts = {f"model_{name}": self.model.get_buffer(name) for name in PARTS}
        found = {**self.seen, **parts, "time": torch.tensor(self.time)}
        return {name: value.clone() for name, value in found.items()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Continue with steps and fits of a state."""
        state = {name: value.clone() for name, value in state.items()}
        parts = {name: state.pop(f"model_{name}") for name in PARTS}
        self.time = int(state.pop("time"))
        if state and not self.seen:
            self.model.expand_to_(state["since"].shape)
        self.seen = state
        self.model.fitted_(**parts)


def _named(rows: list[Any], table: FaultTable) -> list[Any]:
    return [table.words[k] if isinstance(k, int) else _named(k, table) for k in rows]
