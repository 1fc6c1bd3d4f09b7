"""A fast learner: the few numbers of a calibrated model, by recursive least squares."""

from __future__ import annotations

import math
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Calibrated
from afm_rl.errors import (
    ConfigurationError,
    check_choice,
    check_count,
    check_flag,
    check_number,
)
from afm_rl.learning.error_decomposition import ErrorParts, decompose_error
from afm_rl.learning.learner import Learner
from afm_rl.learning.matched_fit import MatchedFit
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.learning.regime_memory import Rules
from afm_rl.learning.unmatched_fit import UnmatchedFit

PARTS = ("all", "matched", "unmatched")
COUPLING, BIAS = 0.1, 0.1  # spread of the prior, relative to that of gains and in half ranges


class RLSUpdater(Learner):
    r"""Recursive least squares on the calibration of a model, per mission, at every step.

    A transition is taken apart into the action v that explains it best and a rest that no action
    explains (:func:`~afm_rl.learning.error_decomposition.decompose_error`). Then, with u the
    executed action in half ranges,

    * *matched*: :math:`v = D\,\psi(u) + b`, a regression per action axis. The prior is wide for
      gains and narrow for coupling and bias, so that two transitions are enough for a change of
      gains, and fades. Where no affine map explains the latest transitions, a shape :math:`\psi`
      is searched that does: a dead zone, a limit, or slip;
    * *unmatched*: the rest is c seen through the projection onto what no action reaches.

    Both are fits to the latest transitions, made anew at each step. An innovation is taken for an
    outlier until the next transition confirms it; then it is a change, and what was learnt before
    is dropped. A fit that is not clearly better than the nominal model is not used, and once the
    nominal model explains everything again the calibration is the identity, exactly
    (:func:`~afm_rl.learning.regime_memory.advance`).

    Missions learn from their own transitions, in one batch; with one calibration for all,
    simultaneous transitions count together. Transitions with a faulty or stale reading are
    refused, see :class:`~afm_rl.learning.Learner`. Those that ``mask_key`` excludes are only
    measured.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.Calibrated` model, whose keys are read.
        part: ``"matched"``, ``"unmatched"`` or ``"all"``. Beside an action flow transform, which
            undoes what actions can undo, choose ``"unmatched"``: otherwise both correct the same.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: normalised innovation beyond which a transition is suspect.
        patience: transitions for which the nominal model is as good before a fit is dropped.
        confirm: take an innovation for an outlier until the next transition confirms it.
        restart: drop what was learnt before a confirmed change.
        window: transitions that are kept; more are forgotten at once.
        shapes: search shapes; False for affine maps only.
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
        confirm: bool = True,
        restart: bool = True,
        window: int = 64,
        shapes: bool = True,
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
        rules = Rules(
            check_count("updater.window", window),
            check_number("updater.forgetting", forgetting, low=0.0, high=1.0, open_low=True),
            check_number("updater.gate", gate, low=0.0, open_low=True),
            check_count("updater.patience", patience),
            check_flag("updater.confirm", confirm),
            check_flag("updater.restart", restart),
        )
        spread = check_number("updater.spread", spread, low=0.0, open_low=True)
        size = model.action_size
        widths = torch.full((size, size + 1), COUPLING * spread, dtype=torch.float64)
        widths[:, :size].fill_diagonal_(spread)
        widths[:, size] = BIAS
        prior = widths.square().reciprocal()
        self.matched = MatchedFit(prior, rules, check_flag("updater.shapes", shapes))
        self.unmatched = UnmatchedFit(model.manifold.tangent_size, rules)

    @property
    def model(self) -> Calibrated:
        """The model that learns."""
        return cast(Calibrated, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Forget the transitions so far; the calibration stays until the next one."""
        super().start(tensordict)
        missions = math.prod(self.model.lead)
        self.matched.clear(missions)
        self.unmatched.clear(missions, self.model.bias.device)

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
            self.matched.learn(unit, parts, valid)
            names = ("matrix", "bias", "shape")
            calibration.update(zip(names, self.matched.calibration(), strict=True))
        if self.part != "matched":
            self.unmatched.learn(flat(offset), parts, valid)
            calibration["offset"] = self.unmatched.calibration()
        model.calibrate_(
            **{name: part.reshape((*lead, *part.shape[1:])) for name, part in calibration.items()}
        )


def _wide(valid: Tensor, like: Tensor) -> Tensor:
    return valid.reshape(*valid.shape, *(1,) * (like.dim() - 2))
