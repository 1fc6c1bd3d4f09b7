"""A fast learner: the few numbers of a calibrated model, by recursive least squares."""

from __future__ import annotations

import math
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Calibrated
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_number
from afm_rl.learning.error_decomposition import ErrorParts, decompose_error
from afm_rl.learning.learner import Learner
from afm_rl.learning.least_squares import Rows, advance, nothing
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.mission_state import MissionState

PARTS = ("all", "matched", "unmatched")


class RLSUpdater(Learner):
    r"""Recursive least squares on the calibration of a model, per mission, at every step.

    A transition is taken apart into the action v that explains it best and a rest that no action
    explains (:func:`~afm_rl.learning.error_decomposition.decompose_error`). Then, with u the
    executed action in half ranges,

    * *matched*: :math:`v = D u + b`, a regression per action axis. The prior is wide for gains
      and narrow for coupling and bias, so that two transitions are enough for a change of gains,
      and fades;
    * *unmatched*: the rest is c seen through the projection onto what no action reaches.

    An innovation beyond the gate is a change: the fit starts anew with it. Once the nominal model
    explains everything again the calibration is the identity, exactly
    (:func:`~afm_rl.learning.least_squares.advance`).

    Missions learn from their own transitions, in one batch; with one calibration for all,
    simultaneous transitions count together. Transitions with a faulty or stale reading are
    refused, see :class:`~afm_rl.learning.Learner`. Those that ``mask_key`` excludes are only
    measured.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.Calibrated` model, whose keys are read.
        part: ``"matched"``, ``"unmatched"`` or ``"all"``. Beside an action flow transform, which
            undoes what actions can undo, choose ``"unmatched"``: otherwise both correct the same.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: normalised innovation beyond which a transition is a change.
        patience: transitions for which the nominal model is as good before a fit is dropped.
        spread: standard deviation of the prior of gains.
        coupling: that of coupling, and of the bias in half ranges.
        offset: that of c, in standard deviations of the model.
        still: half ranges; smaller actions say nothing about slopes, and nothing is forgotten.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?

    Raises:
        ConfigurationError: for a setting out of range, or a model that is not calibrated.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> model = Calibrated(Dubins(), torch.tensor([1.0, 1.5]))
    >>> updater = RLSUpdater(GaussianNLLLoss(model))
    >>> for k, (v, w) in enumerate([(1.0, 0.3), (0.6, -0.5), (-0.4, 0.8), (0.9, 0.7)]):
    ...     s = torch.full((3,), float(k))
    ...     td = TensorDict({"observation": s, "action": torch.tensor([v, w])})
    ...     _ = updater(td.set(("next", "observation"), Dubins()(s, torch.tensor([-v, w / 2]))))
    >>> model.matrix.round(decimals=3) + 0.0
    tensor([[-1.0000,  0.0000],
            [ 0.0000,  0.5000]])
    """

    sets = "calibration"

    def __init__(
        self,
        loss: GaussianNLLLoss,
        part: str = "all",
        forgetting: float = 0.97,
        gate: float = 5.0,
        patience: int = 10,
        spread: float = 1.0,
        coupling: float = 0.1,
        offset: float = 100.0,
        still: float = 0.05,
        mask_key: NestedKey | None = None,
    ) -> None:
        super().__init__(loss, mask_key)
        if not isinstance(loss.model, Calibrated):
            raise ConfigurationError(
                f"updater: RLSUpdater teaches a Calibrated model, got {type(loss.model).__name__}; "
                "choose dynamics=calibrated or dynamics=calibrated_pe"
            )
        self.part = check_choice("updater.part", part, PARTS)
        self.forgetting = check_number(
            "updater.forgetting", forgetting, low=0.0, high=1.0, open_low=True
        )
        self.gate = check_number("updater.gate", gate, low=0.0, open_low=True)
        self.patience = check_count("updater.patience", patience)
        self.spread, self.coupling, self.offset = (
            check_number(f"updater.{name}", value, low=0.0, open_low=True)
            for name, value in (("spread", spread), ("coupling", coupling), ("offset", offset))
        )
        self.still = check_number("updater.still", still, low=0.0)
        self.matched, self.unmatched = (MissionState(nothing(0, 1, 1)) for _ in range(2))

    @property
    def model(self) -> Calibrated:
        """The model that learns."""
        return cast(Calibrated, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Forget the transitions so far; the calibration stays until the next one."""
        super().start(tensordict)
        missions, device = math.prod(self.model.lead), self.model.bias.device
        size = self.model.action_size
        self.matched.keep(nothing(missions, size, size + 1, device))
        self.unmatched.keep(nothing(missions, 1, self.model.manifold.tangent_size, device))

    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Learn from transitions ``(*L, *N)``, where ``learn`` says so."""
        model, lead = self.model, self.model.lead
        valid = learn.reshape(math.prod(lead), -1)
        state, action, after = (
            part.reshape(*lead, valid.shape[1], part.shape[-1])
            for part in (transitions.get(key) for key in self.loss.in_keys)
        )
        offset = model.offset.unsqueeze(-2)
        cleared = model.manifold.add(after, -offset.to(after))
        apart = decompose_error(model.model, state, action, cleared, model.half_range)

        def flat(part: Tensor) -> Tensor:
            return part.double().reshape(len(valid), -1, *part.shape[len(lead) + 1 :])

        parts = ErrorParts(*(flat(part) for part in apart))
        for part in parts:
            valid = valid & part.flatten(2).isfinite().all(-1)
        parts = ErrorParts(*(torch.where(_wide(valid, part), part, 1.0) for part in parts))
        calibration: dict[str, Tensor] = {}
        if self.part != "unmatched":
            unit = torch.where(valid.unsqueeze(-1), flat(action / model.half_range), 0.0)
            theta = self._advance(self.matched, self._matched(unit, parts, valid))
            linear, calibration["bias"] = theta[..., :-1], theta[..., -1]
            calibration["matrix"] = linear + torch.eye(model.action_size).to(linear)
        if self.part != "matched":
            theta = self._advance(self.unmatched, self._unmatched(flat(offset), parts, valid))
            calibration["offset"] = theta.squeeze(1)
        model.calibrate_(
            **{name: part.reshape((*lead, *part.shape[1:])) for name, part in calibration.items()}
        )

    def _advance(self, state: MissionState, rows: Rows) -> Tensor:
        """Take in the latest transitions; return what they say, 0 where the nominal model holds."""
        fit = advance(state.parts, rows, self.forgetting, self.gate, self.patience)
        state.keep(fit)
        return torch.where(fit.active[:, None, None], fit.solution()[0], 0.0)

    def _matched(self, unit: Tensor, parts: ErrorParts, valid: Tensor) -> Rows:
        """Return the regressions of v - u on u and 1."""
        size = unit.shape[-1]
        widths = unit.new_full((size, size + 1), self.coupling)
        widths[:, :size] *= self.spread
        widths[:, :size].fill_diagonal_(self.spread)
        prior = widths.square().reciprocal().expand(len(unit), -1, -1)
        features = torch.cat([unit, torch.ones_like(unit[..., :1])], -1)
        exciting = (unit.abs() > self.still).any(-1)
        return Rows(features, parts.effective - unit, parts.weight, valid, exciting, prior)

    def _unmatched(self, offset: Tensor, parts: ErrorParts, valid: Tensor) -> Rows:
        """Return the regression of the rest on what shows of c, both in standard deviations."""
        across = parts.projection / parts.noise.unsqueeze(-2)
        total = parts.unmatched + (across @ offset.unsqueeze(-1)).squeeze(-1)
        y = total.flatten(1).unsqueeze(-1)
        prior = (self.offset * parts.noise.mean(1, keepdim=True)).square().reciprocal()
        return Rows(across.flatten(1, 2), y, torch.ones_like(y), valid, valid, prior)


def _wide(valid: Tensor, like: Tensor) -> Tensor:
    return valid.reshape(*valid.shape, *(1,) * (like.dim() - 2))
