"""A fast learner: the few numbers of a calibrated model, by recursive least squares."""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Calibrated
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_number
from afm_rl.learning.error_decomposition import ErrorParts, decompose_error
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.learning.updater import Learner
from afm_rl.mission_state import MissionState


class Rows(NamedTuple):
    """The latest transitions of l missions, n simultaneous ones, of K rows each."""

    features: Tensor
    """What the deviation is linear in, phi ``(l, n K, R)``."""
    deviation: Tensor
    """How far the robot was from what the nominal model says, y ``(l, n K, G)``."""
    weight: Tensor
    """One over the variance of the noise of y, w ``(l, n K, G)``."""
    valid: Tensor
    """Which transitions count, ``(l, n)``."""
    exciting: Tensor
    """Which of them say anything about slopes, ``(l, n)``: nothing is forgotten for the others."""
    prior: Tensor
    """Information of the prior of a fit that begins here, ``(l, G, R)``."""


class Fit(NamedTuple):
    r"""G regressions :math:`y_g = \theta_g^\top \phi` for each of l missions.

    >>> u, zero = torch.tensor([[[-1.0], [0.5], [2.0]]]).double(), torch.zeros(1, 3).bool()
    >>> rows = Rows(u, 3 * u, torch.ones_like(u), ~zero, ~zero, torch.full((1, 1, 1), 1e-6))
    >>> advance(nothing(1, 1, 1), rows, gate=1.0).solution()[0].round(decimals=3)
    tensor([[[3.]]], dtype=torch.float64)
    """

    information: Tensor
    """Sum of w phi phi' over the transitions that count, ``(l, G, R, R)``."""
    moment: Tensor
    """Sum of w phi y over them, ``(l, G, R)``."""
    prior: Tensor
    """Information of the prior, around zero, ``(l, G, R)``."""
    age: Tensor
    """Number of transitions since the fit began, ``(l)``."""
    level: Tensor
    """Median innovation so far, at least 1: the level of the noise, ``(l)``."""
    quiet: Tensor
    """For how many transitions the nominal model has been as good as the fit, ``(l)``."""
    active: Tensor
    """Is there a fit? Otherwise the nominal model holds, ``(l)``."""

    def solution(self) -> tuple[Tensor, Tensor]:
        r"""Return mean ``(l, G, R)`` and covariance ``(l, G, R, R)`` of theta.

        .. math:: \Sigma_g = (\textstyle\sum w \phi \phi^\top + P_g)^{-1},\qquad
                  \theta_g = \Sigma_g \textstyle\sum w \phi y_g

        The prior P halves with each transition: it leads first and hardly pulls later.
        """
        fading = (0.5**self.age).clamp_min(1e-4)[:, None, None]
        precision = self.information + torch.diag_embed(self.prior * fading)
        covariance = torch.linalg.inv_ex(precision).inverse
        return (covariance @ self.moment.unsqueeze(-1)).squeeze(-1), covariance


def nothing(
    missions: int, regressions: int, features: int, device: torch.device | None = None
) -> Fit:
    """Return what is known at first, in double precision: the nominal model holds."""
    shape = missions, regressions, features, features
    matrix = torch.zeros(shape, device=device, dtype=torch.float64)
    vector, count = matrix[..., 0], matrix.new_zeros(missions)
    return Fit(matrix, vector, vector + 1, count, count + 1, count, count.bool())


def advance(
    fit: Fit, rows: Rows, forgetting: float = 0.97, gate: float = 5.0, patience: int = 10
) -> Fit:
    """Take in the latest transitions; nothing happens to missions without a valid one.

    * An innovation beyond the gate is a change: what was known is dropped, and a fit begins with
      this transition, or none if the nominal model explains it. A fit of few transitions is not
      judged yet.
    * Innovations are measured by the noise that the fit has had so far, if that is more than the
      model's: a robot of which no transition is as predicted is noisy, it does not change.
    * A fit is also dropped once the nominal model has been as good for ``patience`` transitions.
    """
    theta, covariance = fit.solution()
    features, y, weight, valid, exciting, prior = rows
    variance = torch.einsum("lnr,lgrk,lnk->lng", features, covariance, features)
    error = (y - features @ theta.mT).square() * weight / (1 + weight * variance)
    innovation, nominal = _size(error, valid), _size(y.square() * weight, valid)
    innovation = torch.where(fit.active, innovation, nominal)
    shown, telling = valid.any(-1), (exciting & valid).any(-1)
    explained = nominal <= gate
    settled = fit.active & (fit.age > features.shape[-1] + 1)
    changed = (innovation > gate * fit.level) & (settled | ~fit.active)
    as_good = explained & (nominal <= 1.5 * innovation.clamp_min(1.0))
    quiet = torch.where(fit.active & as_good, fit.quiet + telling, 0.0)
    ended = fit.active & ((changed & explained) | (quiet >= patience))
    active, fresh = (fit.active | changed) & ~ended, changed | ended
    # A median that is followed: up by a fifth where it is exceeded, else down.
    rise = torch.where(innovation > fit.level, 0.2, -0.2).exp()
    level = torch.where(settled, (fit.level * rise).clamp_min(1.0), fit.level)
    keep = torch.where(fresh, 0.0, torch.where(telling, forgetting, 1.0).to(y))
    rows_of = y.shape[1] // valid.shape[1]
    counts = (valid & active.unsqueeze(-1)).repeat_interleave(rows_of, 1).unsqueeze(-1)
    weighted = (weight * counts).mT.unsqueeze(-1) * features.unsqueeze(1)
    after = Fit(
        information=_like(keep, fit.information) * fit.information
        + weighted.mT @ features.unsqueeze(1),
        moment=_like(keep, fit.moment) * fit.moment + (weighted * y.mT.unsqueeze(-1)).sum(-2),
        prior=torch.where(_like(fresh, prior), prior, fit.prior),
        age=torch.where(fresh, 0.0, fit.age) + active,
        level=torch.where(ended, 1.0, level),
        quiet=torch.where(fresh, 0.0, quiet),
        active=active,
    )
    return Fit(
        *(torch.where(_like(shown, new), new, old) for new, old in zip(after, fit, strict=True))
    )


def _like(missions: Tensor, part: Tensor) -> Tensor:
    """Return one number per mission, ``(l)``, as it broadcasts with ``(l, ...)``."""
    return missions.reshape(-1, *(1,) * (part.dim() - 1))


def _size(squares: Tensor, valid: Tensor) -> Tensor:
    """Return the largest error of each transition, of these the median ``(l)``; 0 for none."""
    largest = squares.flatten(1).unflatten(1, (valid.shape[1], -1)).amax(-1).sqrt()
    return torch.where(valid, largest, torch.nan).nanmedian(-1).values.nan_to_num(0.0)


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
    (:func:`~afm_rl.learning.rls_updater.advance`).

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
