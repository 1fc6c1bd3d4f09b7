"""A fast learner: the few numbers of a calibrated model, by recursive least squares."""

from __future__ import annotations

import math
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Calibrated
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag, check_number
from afm_rl.keys import as_key
from afm_rl.learning.effects import Effect, take_apart
from afm_rl.learning.matched_fit import MatchedFit
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.learning.regime_memory import Rules
from afm_rl.learning.unmatched_fit import UnmatchedFit
from afm_rl.learning.updater import ABSURD, Updater

PARTS = ("all", "matched", "unmatched")
COUPLING, BIAS = 0.1, 0.1  # spread of the prior, relative to that of gains and in half ranges


class RLSUpdater(Updater):
    r"""Recursive least squares on the calibration of a model, per mission, at every step.

    A transition is taken apart into the action v that explains it best and a rest that no action
    explains (:func:`~afm_rl.learning.effects.take_apart`). Then, with u the executed action,

    * *matched*: :math:`v = D\,\psi(u) + b`, a regression per action axis. The prior is wide for
      gains and narrow for coupling and bias, so that two transitions do for a change of gains,
      and it fades: a handful decide. Where no affine map explains the last ``window``
      transitions, a shape :math:`\psi` is searched that does: a dead zone, a limit, or slip;
    * *unmatched*: the rest is c seen through the projection onto what no action reaches.

    Both take a surprise for an outlier until the next transition confirms it; then it is a
    change, and what was learnt before is dropped. What is no better than the nominal model is not
    believed, and once that explains everything again the calibration is the identity, exactly.
    See :func:`~afm_rl.learning.regime_memory.advance`.

    Missions learn from their own transitions, in one batch; with one calibration for all,
    simultaneous transitions count together. Transitions that are not finite or absurdly large
    are refused: they have no influence, their loss is reported as NaN, and :attr:`refused`
    counts them. Those that ``mask_key`` excludes are only measured.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.Calibrated` model, whose keys are read.
        part: ``"matched"``, ``"unmatched"`` or ``"all"``. Beside an action flow transform, which
            undoes what actions can undo, choose ``"unmatched"``: otherwise both correct the same.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: standard deviations of the prediction beyond which a transition is a surprise.
        patience: transitions for which the nominal model is as good before a fit is dropped.
        confirm: hold a surprise back until the next transition confirms it.
        restart: drop what was learnt before a confirmed surprise.
        window: transitions among which a shape is searched; 0 for affine maps only.
        spread: standard deviation of the prior of gains.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?

    Raises:
        ConfigurationError: for a setting out of range, or a model that is not calibrated.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> model = Calibrated(Dubins(), torch.tensor([1.0, 1.5]))
    >>> updater = RLSUpdater(GaussianNLLLoss(model))
    >>> s = torch.zeros(3)
    >>> for v, w in ((1.0, 0.3), (0.6, -0.5), (-0.4, 0.8), (0.9, 0.7)):
    ...     td = TensorDict({"observation": s, "action": torch.tensor([v, w])})
    ...     _ = updater(td.set(("next", "observation"), Dubins()(s, torch.tensor([-v, w / 2]))))
    >>> model.matrix.round(decimals=3) + 0.0
    tensor([[-1.0000,  0.0000],
            [ 0.0000,  0.5000]])
    """

    learns, sets = True, "calibration"
    missions: Tensor

    def __init__(
        self,
        loss: GaussianNLLLoss,
        part: str = "all",
        forgetting: float = 0.97,
        gate: float = 5.0,
        patience: int = 10,
        confirm: bool = True,
        restart: bool = True,
        window: int = 32,
        spread: float = 1.0,
        mask_key: NestedKey | None = None,
    ) -> None:
        super().__init__(loss)
        model = loss.model
        if not isinstance(model, Calibrated):
            raise ConfigurationError(
                f"updater: RLSUpdater teaches a Calibrated model, got {type(model).__name__}; "
                "choose dynamics=calibrated or dynamics=calibrated_pe"
            )
        self.part = check_choice("updater.part", part, PARTS)
        rules = Rules(
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
        window = check_count("updater.window", window, low=0)
        self.matched = MatchedFit(widths.square().reciprocal(), rules, window)
        self.unmatched = UnmatchedFit(model.manifold.tangent_size, rules)
        # Not persistent: what is under way belongs to missions, not to a stored model.
        self.register_buffer("missions", torch.tensor(-1), persistent=False)
        self.mask_key = None if mask_key is None else as_key(mask_key)
        self.refused = 0
        self.claim()

    @property
    def model(self) -> Calibrated:
        """The model that learns."""
        return cast(Calibrated, self.loss.model)

    def start(self, tensordict: TensorDictBase) -> None:
        """Forget the transitions so far; the calibration stays until the next one."""
        missions = math.prod(self.model.lead)
        self.matched.clear(missions, self.model.bias)
        self.unmatched.clear(missions, self.model.bias)
        self.missions = self.model.missions.clone()  # a buffer of its own, or checkpoints lose it

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the loss, then learn."""
        result = super().forward(tensordict)
        self._follow(tensordict)
        batch, lead = tensordict.batch_size, self.model.lead
        parts = [tensordict.get(key) for key in self.loss.in_keys]
        sound = result["loss"].isfinite()
        for part in parts:
            sound = sound & (part.abs() < ABSURD).all(-1)
        valid = sound
        if self.mask_key is not None:
            valid = sound & tensordict.get(self.mask_key).reshape(batch)
        valid = valid.reshape(math.prod(lead), -1)
        state, action, after = (
            part.reshape(*lead, valid.shape[1], part.shape[-1]) for part in parts
        )
        self._learn(state, action, after, valid)
        self.refused += int((~sound).sum())
        return result.set("loss", torch.where(sound, result["loss"], torch.nan))

    def _learn(self, state: Tensor, action: Tensor, after: Tensor, valid: Tensor) -> None:
        """Learn from transitions ``(*L, n, ...)``, of which those count that are ``valid``."""
        model, lead = self.model, self.model.lead
        guess, offset = model.effective(action) / model.half_range, model.offset.unsqueeze(-2)
        effect = take_apart(model.model, state, guess, after, model.half_range, offset)

        def flat(part: Tensor) -> Tensor:
            return part.double().reshape(len(valid), -1, *part.shape[len(lead) + 1 :])

        effect = Effect(*(flat(part) for part in effect))
        for part in effect:
            valid = valid & part.flatten(2).isfinite().all(-1)
        if self.part != "unmatched":
            self.matched.learn(flat(action / model.half_range), effect, valid)
            matrix, bias, shape = self.matched.calibration()
            told = {"matrix": matrix, "bias": bias, "shape": shape}
            model.tell_(
                **{name: part.reshape(*lead, *part.shape[1:]) for name, part in told.items()}
            )
        if self.part != "matched":
            self.unmatched.learn(flat(offset), effect, valid)
            model.tell_(offset=self.unmatched.calibration().reshape(*lead, -1))

    def _follow(self, tensordict: TensorDictBase) -> None:
        """Keep what is known of the missions that the model still has."""
        left, known = self.model.missions, self.missions
        if left.shape == known.shape and torch.equal(left, known):
            return
        if left.dim() and known.dim() and bool(torch.isin(left, known).all()):
            index = (left.unsqueeze(-1) == known).int().argmax(-1)
            self.matched.select_(index)
            self.unmatched.select_(index)
            self.missions = left.clone()
        else:
            self.start(tensordict)
