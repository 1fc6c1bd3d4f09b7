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
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.learning.recursive_least_squares import (
    Filter,
    Information,
    News,
    absorb,
    empty_filter,
    fading_prior,
    solve,
    update,
)
from afm_rl.learning.updater import Updater
from afm_rl.mission_state import MissionState

PARTS = ("all", "matched", "unmatched")
SLIPS = (0.5, 8.0)  # lowest and highest slip that is tried
COUPLING, BIAS = 0.1, 0.1  # spread of the prior, relative to that of gains and in half ranges
OFFSET = 100.0  # spread of the prior of c, in standard deviations of the model
EXCITING = 0.05  # half ranges: a smaller action tells nothing about slopes


class RLSUpdater(Updater):
    r"""Recursive least squares on the calibration of a model, per mission, at every step.

    A transition is taken apart into the action v that explains it best and a rest that no action
    explains (:func:`~afm_rl.learning.error_decomposition.decompose_error`). Then, with u the
    executed action in half ranges,

    * *matched*: :math:`v = D\,\psi_\kappa(u) + b`, a regression per action axis. Hypotheses
      compete: no slip, and a grid of slips :math:`\kappa`. The prior is wide for gains and narrow
      for coupling and bias, so that two transitions are enough for a change of gains, and fades;
    * *unmatched*: the rest is c seen through the projection onto what no action reaches.

    An innovation is taken for an outlier until the next transition confirms it; then it is a
    change, and what was learnt before is dropped. A fit that is not clearly better than the
    nominal model is not used (:func:`~afm_rl.learning.recursive_least_squares.update`).

    Missions learn from their own transitions, in one batch; with one calibration for all,
    simultaneous transitions count together. Transitions with a faulty or stale reading are
    refused, see :class:`~afm_rl.learning.Updater`. Those that ``mask_key`` excludes are only
    measured.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.Calibrated` model, whose keys are read.
        part: ``"matched"``, ``"unmatched"`` or ``"all"``. Beside an action flow transform, which
            undoes what actions can undo, choose ``"unmatched"``: otherwise both correct the same.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: normalised innovation beyond which a transition is suspect.
        slips: size of the grid of slips; 0 for affine maps only.
        spread: standard deviation of the prior of gains.
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
    >>> model.matrix.round(decimals=2) + 0.0
    tensor([[-1.0000,  0.0000],
            [ 0.0000,  0.5000]])
    """

    learns, sets = True, "calibration"
    prior: Tensor
    slips: Tensor

    def __init__(
        self,
        loss: GaussianNLLLoss,
        part: str = "all",
        forgetting: float = 0.97,
        gate: float = 5.0,
        slips: int = 24,
        spread: float = 1.0,
        mask_key: NestedKey | None = None,
    ) -> None:
        super().__init__(loss, mask_key)
        model = loss.model
        if not isinstance(model, Calibrated):
            raise ConfigurationError(
                f"updater: RLSUpdater teaches a Calibrated model, got {type(model).__name__}; "
                "choose dynamics=calibrated or dynamics=calibrated_pe"
            )
        self.part = check_choice("updater.part", part, PARTS)
        self.forgetting = check_number(
            "updater.forgetting", forgetting, low=0.0, high=1.0, open_low=True
        )
        self.gate = check_number("updater.gate", gate, low=0.0, open_low=True)
        spread = check_number("updater.spread", spread, low=0.0, open_low=True)
        size = model.action_size
        widths = torch.full((size, size + 1), COUPLING * spread, dtype=torch.float64)
        widths[:, :size].fill_diagonal_(spread)
        widths[:, size] = BIAS
        self.register_buffer("prior", widths.square().reciprocal(), persistent=False)
        low, high = (math.log(slip) for slip in SLIPS)
        grid = torch.linspace(low, high, check_count("updater.slips", slips, low=0)).exp().double()
        grid = torch.cat([torch.zeros(1).double(), grid])
        self.register_buffer("slips", grid, persistent=False)
        self.matched, self.unmatched = (MissionState(part) for part in self._empty(0))
        self.claim()

    @property
    def model(self) -> Calibrated:
        """The model that learns."""
        return cast(Calibrated, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Forget the transitions so far; the calibration stays until the next one."""
        super().start(tensordict)
        for state, part in zip(
            (self.matched, self.unmatched), self._empty(math.prod(self.model.lead)), strict=True
        ):
            state.keep(part)

    def _empty(self, missions: int):
        size, hypotheses = self.model.action_size, len(self.slips)
        parts = (
            empty_filter(missions, hypotheses, size, size + 1),
            empty_filter(missions, 1, 1, self.model.manifold.tangent_size),
        )
        device = self.model.bias.device
        return [type(part)(*(value.to(device) for value in part)) for part in parts]

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
        if self.part != "unmatched":
            unit = torch.where(valid.unsqueeze(-1), flat(action / model.half_range), 0.0)
            calibration = self._learn_matched(unit, parts, valid)
        else:
            calibration = {}
        if self.part != "matched":
            calibration["offset"] = self._learn_unmatched(flat(offset), parts, valid)
        shaped = {
            name: part.reshape((*lead, *part.shape[1:])) for name, part in calibration.items()
        }
        model.calibrate_(**shaped)

    def _learn_matched(self, unit: Tensor, parts: ErrorParts, valid: Tensor) -> dict[str, Tensor]:
        """Take in n transitions per mission; return D, b and the slip to use.

        Args:
            unit: u, ``(l, n, A)``.
            parts: of the errors, ``(l, n, ...)``.
            valid: which of them count, ``(l, n)``.
        """
        now, weight = _in_double(self.matched.parts), parts.weight
        wide, slips = self.prior.double(), self.slips.double()
        mean = torch.eye(*wide.shape).to(wide)
        prior = fading_prior(wide, now.age)
        theta, covariance = solve(now.known, prior, mean)  # (l, H, A, R)
        command = unit.unsqueeze(2) * (-slips[:, None] * unit.abs().unsqueeze(2)).exp()
        features = torch.cat([command, torch.ones_like(command[..., :1])], -1)  # (l, n, H, R)
        fitted = torch.einsum("lnhr,lhgr->lnhg", features, theta)
        variance = torch.einsum("lnhr,lhgrk,lnhk->lnhg", features, covariance, features)
        guesses = torch.cat([unit.unsqueeze(2), fitted], 2)
        certain = torch.zeros_like(variance[:, :, :1])
        error = (parts.effective.unsqueeze(2) - guesses).square() * weight.unsqueeze(2)
        doubt = 1 + weight.unsqueeze(2) * torch.cat([certain, variance], 2)
        nothing = Information(*(torch.zeros_like(part).unsqueeze(1) for part in now.known))
        known = absorb(
            nothing,
            features.unsqueeze(3),
            parts.effective.unsqueeze(2),
            weight.unsqueeze(2).expand_as(fitted),
        )
        exciting = (unit.abs() > EXCITING).any(-1)
        news = _pooled(known, error.amax(-1), (error / doubt).amax(-1), exciting, valid)
        now = update(now, news, self.forgetting, self.gate)
        self.matched.keep(now)
        theta, _ = solve(now.known, fading_prior(wide, now.age), mean)
        best = now.best
        chosen = best.clamp_min(0)
        theta = theta[torch.arange(len(best)), chosen]
        theta = torch.where((best >= 0)[:, None, None], theta, mean)
        slip = torch.where(best >= 0, slips[chosen], 0.0)
        return {"matrix": theta[..., :-1], "bias": theta[..., -1], "slip": slip}

    def _learn_unmatched(self, offset: Tensor, parts: ErrorParts, valid: Tensor) -> Tensor:
        """Take in n transitions per mission; return the c ``(l, D)`` to use.

        Args:
            offset: c, as it was when the errors were measured, ``(l, 1, D)``.
            parts: of the errors, ``(l, n, ...)``.
            valid: which of them count, ``(l, n)``.
        """
        now = _in_double(self.unmatched.parts)
        noise = (parts.noise * valid.unsqueeze(-1)).sum(1)
        noise = noise / valid.sum(1, keepdim=True).clamp_min(1)
        width = torch.where(valid.any(1, keepdim=True), OFFSET * noise, 1.0)
        prior = width.square().reciprocal()[:, None, None, :]
        mean = torch.zeros_like(now.moment)
        theta, covariance = solve(now.known, fading_prior(prior, now.age), mean)
        seen = parts.projection / parts.noise.unsqueeze(-2)  # of c, (l, n, D, D)
        total = parts.unmatched + (seen @ offset.unsqueeze(-1)).squeeze(-1)
        fitted = torch.einsum("lndr,lr->lnd", seen, theta[:, 0, 0])
        variance = torch.einsum("lndr,lrk,lndk->lnd", seen, covariance[:, 0, 0], seen)
        error = torch.stack([total, total - fitted], 2).square()
        doubt = 1 + torch.stack([torch.zeros_like(variance), variance], 2)
        known = Information(seen.mT @ seen, (seen.mT @ total.unsqueeze(-1)).squeeze(-1))
        known = Information(*(part[:, :, None, None] for part in known))
        all_tell = torch.ones_like(valid)
        news = _pooled(known, error.amax(-1), (error / doubt).amax(-1), all_tell, valid)
        now = update(now, news, self.forgetting, self.gate)
        self.unmatched.keep(now)
        theta, _ = solve(now.known, fading_prior(prior, now.age), mean)
        return torch.where(now.best[:, None] >= 0, theta[:, 0, 0], 0.0)


def _in_double(parts: Filter) -> Filter:
    """Undo what ``module.to(torch.float32)`` does to a filter, which needs its digits."""
    return Filter(*(p.double() if p.is_floating_point() else p for p in parts))


def _pooled(
    known: Information, error: Tensor, innovation: Tensor, exciting: Tensor, valid: Tensor
) -> News:
    """Take n simultaneous transitions ``(l, n, ...)`` for one: their sum, their median error."""

    def middle(squares: Tensor) -> Tensor:
        counted = torch.where(valid.unsqueeze(-1), squares, torch.nan)
        return counted.nanmedian(1).values.nan_to_num(0.0).sqrt()

    summed = Information(*(torch.where(_wide(valid, part), part, 0.0).sum(1) for part in known))
    tells = (exciting & valid).any(1)
    return News(summed, middle(error), middle(innovation), tells, valid.any(1))


def _wide(valid: Tensor, like: Tensor) -> Tensor:
    return valid.reshape(*valid.shape, *(1,) * (like.dim() - 2))
