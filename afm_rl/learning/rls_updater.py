"""A fast learner: the few numbers of a calibrated model, by recursive least squares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, cast

import torch
from annotated_types import Le
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Calibrated
from afm_rl.errors import ConfigurationError
from afm_rl.learning.error_decomposition import ErrorParts, decompose_error
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.learning.updater import Learner
from afm_rl.options import Positive, options


class Fit(NamedTuple):
    r"""G regressions :math:`y_g = \theta_g^\top \phi` of R numbers, for each of l missions."""

    information: Tensor
    """Sum of w phi phi' over the transitions that count, ``(l, G, R, R)``."""
    moment: Tensor
    """Sum of w phi y over them, ``(l, G, R)``."""
    age: Tensor
    """Number of transitions since the fit began, ``(l)``; 0 where the nominal model holds."""

    def solution(self, prior: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return mean ``(l, G, R)`` and covariance ``(l, G, R, R)`` of theta.

        .. math:: \Sigma_g = (\textstyle\sum w \phi \phi^\top + P_g)^{-1},\qquad
                  \theta_g = \Sigma_g \textstyle\sum w \phi y_g

        with the information P of a prior around zero, ``(l, G, R)``.
        """
        covariance = torch.linalg.inv_ex(self.information + torch.diag_embed(prior)).inverse
        return (covariance @ self.moment.unsqueeze(-1)).squeeze(-1), covariance


def no_fit(
    missions: int, regressions: int, features: int, device: torch.device | None = None
) -> Fit:
    """Return what is known at first, in double precision: the nominal model holds."""
    shape = missions, regressions, features, features
    matrix = torch.zeros(shape, device=device, dtype=torch.float64)
    return Fit(matrix, matrix[..., 0], matrix.new_zeros(missions))


def advance(
    fit: Fit,
    features: Tensor,
    y: Tensor,
    weight: Tensor,
    valid: Tensor,
    prior: Tensor,
    forgetting: float = 0.97,
    gate: float = 5.0,
) -> Fit:
    """Take in the latest transitions: n simultaneous ones of K rows each, for each mission.

    An innovation beyond the gate is a change: what was known is dropped, and a fit begins with
    this transition, or none if the nominal model explains it. A fit of few transitions is not
    judged yet. Nothing happens to missions without a valid transition.

    Args:
        fit: what is known.
        features: phi ``(l, n, K, R)``.
        y: how far the robot was from what the nominal model says, ``(l, n, K, G)``.
        weight: one over the variance of the noise of y, ``(l, n, K, G)``.
        valid: which transitions count, ``(l, n)``.
        prior: information of the prior, ``(l, G, R)``.
        forgetting: weight of a transition relative to the next one.
        gate: standard deviations.

    >>> u, yes = torch.tensor([-1.0, 0.5, 2.0]).double().view(1, 3, 1, 1), torch.ones(1, 3).bool()
    >>> prior = torch.full((1, 1, 1), 1e-6)
    >>> fit = advance(no_fit(1, 1, 1), u, 3 * u, torch.ones_like(u), yes, prior, gate=1.0)
    >>> fit.solution(prior)[0].round(decimals=3)
    tensor([[[3.]]], dtype=torch.float64)
    """
    theta, covariance = fit.solution(prior)
    variance = torch.einsum("lnkr,lgrs,lnks->lnkg", features, covariance, features)
    error = (y - features @ theta.mT.unsqueeze(1)).square() * weight / (1 + weight * variance)
    nominal, active = _typical(y.square() * weight, valid), fit.age > 0
    innovation = torch.where(active, _typical(error, valid), nominal)
    judged = ~active | (fit.age > features.shape[-1] + 1)
    changed = judged & (innovation > gate)
    active = torch.where(changed, nominal > gate, active)
    keep = torch.where(changed, 0.0, forgetting).to(y)
    counts = weight * (valid & active.unsqueeze(-1))[..., None, None]
    after = Fit(
        _like(keep, fit.information) * fit.information
        + torch.einsum("lnkg,lnkr,lnks->lgrs", counts, features, features),
        _like(keep, fit.moment) * fit.moment + torch.einsum("lnkg,lnkr->lgr", counts * y, features),
        torch.where(changed, 0.0, fit.age) + active,
    )
    shown = valid.any(-1)
    return Fit(
        *(torch.where(_like(shown, new), new, old) for new, old in zip(after, fit, strict=True))
    )


def _like(missions: Tensor, part: Tensor) -> Tensor:
    """Return one number per mission, ``(l)``, as it broadcasts with ``(l, ...)``."""
    return missions.reshape(-1, *(1,) * (part.dim() - 1))


def _typical(squares: Tensor, valid: Tensor) -> Tensor:
    """Return the largest error of each transition, of these the median ``(l)``; 0 for none."""
    largest = squares.amax((-2, -1)).sqrt()
    return torch.where(valid, largest, torch.nan).nanmedian(-1).values.nan_to_num(0.0)


class RLSUpdater(Learner):
    r"""Recursive least squares on the calibration of a model, per mission, at every step.

    A transition is decomposed into the action v that explains it best and a remainder that no
    action explains (:func:`~afm_rl.learning.error_decomposition.decompose_error`). Then, with u the
    executed action in half ranges,

    * *matched*: :math:`v = D u + b`, a regression per action axis. The prior is wide for gains
      and narrower for coupling and bias, so that two transitions are enough for a change of gains;
    * *unmatched*: the remainder is c, projected onto the directions that no action reaches.

    An innovation beyond the gate is a change: the fit starts again with it (resetting of the
    covariance), or, if the nominal model explains it, the calibration becomes exactly the identity.

    Missions learn from their own transitions, in one batch; with one calibration for all,
    simultaneous transitions count together. Transitions with a faulty or stale reading are
    refused, see :class:`~afm_rl.learning.Learner`. Those that :attr:`mask_key` excludes are only
    measured.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.Calibrated` model, whose keys are read.

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

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        part: Annotated[
            Literal["matched", "unmatched", "all"],
            "matched: errors that actions can cancel; unmatched: the rest, for use with AFM; all",
        ] = "all",
        forgetting: Annotated[
            Positive, Le(1), "weight of a transition relative to the next"
        ] = 0.97,
        gate: Annotated[Positive, "innovation beyond which a transition is a change"] = 5.0,
        spread: Annotated[Positive, "prior deviation of gains; coupling, bias: a tenth"] = 100.0,
    ) -> None:
        super().__init__(loss)
        if not isinstance(loss.model, Calibrated):
            raise ConfigurationError(
                f"updater: RLSUpdater updates a Calibrated model, got {type(loss.model).__name__}; "
                "choose dynamics=calibrated"
            )
        self.part, self.forgetting, self.gate, self.spread = part, forgetting, gate, spread

    @property
    def model(self) -> Calibrated:
        """The model that learns."""
        return cast(Calibrated, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Forget the transitions so far; the calibration stays until the next one."""
        super().start(tensordict)
        missions, device = math.prod(self.model.lead), self.model.bias.device
        axes, coordinates = self.model.action_size, self.model.manifold.tangent_size
        self.memory["matched"] = no_fit(missions, axes, axes + 1, device)._asdict()
        self.memory["unmatched"] = no_fit(missions, 1, coordinates, device)._asdict()

    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
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
        blank = (valid.reshape(*valid.shape, *(1,) * (part.dim() - 2)) for part in parts)
        parts = ErrorParts(
            *(torch.where(here, part, 1.0) for here, part in zip(blank, parts, strict=True))
        )
        calibration: dict[str, Tensor] = {}
        if self.part != "unmatched":
            theta = self._fit_matched(flat(action / model.half_range), parts, valid)
            linear, calibration["bias"] = theta[..., :-1], theta[..., -1]
            calibration["matrix"] = linear + torch.eye(model.action_size).to(linear)
        if self.part != "matched":
            calibration["offset"] = self._fit_unmatched(flat(offset), parts, valid).squeeze(1)
        model.calibrate_(
            **{name: part.reshape((*lead, *part.shape[1:])) for name, part in calibration.items()}
        )

    def _fit_matched(self, unit: Tensor, parts: ErrorParts, valid: Tensor) -> Tensor:
        """Return the regressions of v - u on u and 1, ``(l, A, A + 1)``."""
        unit = torch.where(valid.unsqueeze(-1), unit, 0.0)
        size = unit.shape[-1]
        features = torch.cat([unit, torch.ones_like(unit[..., :1])], -1)
        prior = self.spread**-2 * (100.0 - 99.0 * torch.eye(size, size + 1)).to(unit)
        rows = [part.unsqueeze(-2) for part in (features, parts.effective - unit, parts.weight)]
        return self._advance("matched", rows, valid, prior.expand(len(unit), -1, -1))

    def _fit_unmatched(self, offset: Tensor, parts: ErrorParts, valid: Tensor) -> Tensor:
        """Return the regression of the rest on what shows of c, ``(l, 1, D)``."""
        across = parts.projection / parts.noise.unsqueeze(-2)
        y = (parts.unmatched + (across @ offset.unsqueeze(-1)).squeeze(-1)).unsqueeze(-1)
        prior = (self.spread * parts.noise.mean(1, keepdim=True)).square().reciprocal()
        return self._advance("unmatched", [across, y, torch.ones_like(y)], valid, prior)

    def _advance(self, name: str, rows: Sequence[Tensor], valid: Tensor, prior: Tensor) -> Tensor:
        """Take in the latest transitions; return what they say, 0 where the nominal model holds."""
        features, y, weight = rows
        fit = Fit(**self.memory[name])
        fit = advance(fit, features, y, weight, valid, prior, self.forgetting, self.gate)
        self.memory[name] = fit._asdict()
        return torch.where(fit.age[:, None, None] > 0, fit.solution(prior)[0], 0.0)
