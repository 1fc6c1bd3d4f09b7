"""Textbook correctors: one fit to all that is remembered, used while the model is contradicted."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal, NamedTuple

import torch
from annotated_types import Le
from torch import Tensor

from afm_rl.compiling.tracing import somewhere
from afm_rl.correction.achievable import Saturation, saturate
from afm_rl.correction.base import Correction, Fields
from afm_rl.correction.least_squares import (
    fit_affine,
    fit_gain,
    fit_line,
    invert_affine,
    not_zero,
)
from afm_rl.correction.pairs import PairCorrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.options import Count, NonNegative, Positive, options

NOISE = 0.1  # shares of the largest action: a pair with this standard deviation counts half


class Rows(NamedTuple):
    """Pairs that describe a regime, oldest first, in shares of the largest action."""

    executed: Tensor
    """Executed actions u, ``(*B, K, A)``."""
    effective: Tensor
    """Their effective actions, ``(*B, K, A)``."""
    std: Tensor
    """Standard deviation of the effective actions, ``(*B, K, A)``."""
    valid: Tensor
    """Which rows count, ``(*B, K, 1)``, 0 or 1."""


class ClassicalCorrector(PairCorrector):
    """A corrector that answers a plan from all pairs that it remembers, as the textbooks do.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
    """

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        window: Annotated[Count, "size of the memory, transitions, K"] = 24,
        gate: Annotated[NonNegative, "innovation below which the action passes through, std"] = 5.0,
        saturation: Saturation = "mixed",
    ) -> None:
        super().__init__(action_low, action_high, window, window, gate)
        self.saturation = saturation

    def rows(self, pairs: Tensor) -> Rows:
        """Return the pairs ``(*B, K, D)`` as rows."""
        size = self.action_size
        sizes = [size, size, size, 1, 1]
        executed, effective, std, valid, _ = pairs.split(sizes, -1)
        return Rows(executed, effective, std, (valid > 0).to(executed))

    def answer(
        self, memory: Fields, planned: Tensor, model: DynamicsModel, bounds: Tensor, limits: Tensor
    ) -> tuple[Fields, Correction]:
        """Answer where the model is contradicted."""
        pairs = self._watched(memory, model)
        innovation, corrected = self._innovation(pairs)

        def invert(pairs: Tensor, planned: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
            rows = self.rows(pairs)
            unit = self.inverse(rows, self.normalise(planned))
            unit = unit.clamp(*self.normalise(limits).unbind(-2))
            return self.denormalise(unit), self.denormalise(self.effect(rows, unit))

        still = [planned, planned]
        executed, predicted = somewhere(corrected, invert, still, pairs, planned, limits)
        correction = self.unchanged(planned, innovation, bounds)._replace(
            executed_action=executed, predicted_effect=predicted, corrected=corrected
        )
        return {"pairs": pairs, "acting": self.normalise(predicted)}, correction

    def _watched(self, memory: Fields, model: DynamicsModel) -> Tensor:
        """Return the pairs with the newest ones, older ones marked where a change begins."""
        pairs = self.remember(memory["pairs"], self.measure(memory, model))
        begins = (memory["corrected"] != 1.0) & (pairs[..., -1:, -1] > self.gate)
        return self.mark_old(pairs, begins)

    def _innovation(self, pairs: Tensor) -> tuple[Tensor, Tensor]:
        innovation = pairs[..., -self.recent :, -1].amax(-1)
        return innovation, innovation > self.gate

    @abstractmethod
    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for a plan, both in u."""

    @abstractmethod
    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Return the effect ``(*B, A)`` of an action, both in u."""


class LeastSquares(ClassicalCorrector):
    r"""Certainty-equivalent adaptive control: fit the regime, execute the inverse.

    Executes :math:`g^{-1} u_0` (``form="gain"``), :math:`g^{-1} (u_0 - b)` with a robust fit
    (``"gain_offset"``, :func:`fit_line`) or :math:`D^{-1} (u_0 - b)`
    (``"affine"``), saturated. Pairs count by their age and, all but ``"affine"``, by their noise.
    Nothing is trained; any control engineer's first answer, and the bar for a learned flow.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.

    >>> LeastSquares(torch.tensor([-1.0]), torch.tensor([1.0])).memory
    24
    """

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        form: Annotated[
            Literal["gain", "gain_offset", "affine"], "gain: one gain per actuator"
        ] = "gain",
        window: int = 24,
        forgetting: Annotated[Positive, Le(1), "weight of a transition relative to the next"] = 0.8,
        gate: float = 5.0,
        saturation: Saturation = "clip",
    ) -> None:
        super().__init__(action_low, action_high, window, gate, saturation)
        self.form, self.forgetting = form, forgetting

    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Invert the fit."""
        matrix, offset = self._fit(rows)
        if self.form == "affine":
            columns = (part.unsqueeze(-1) for part in (offset, planned))
            return saturate(invert_affine(matrix, *columns).squeeze(-1), self.saturation)
        return saturate((planned - offset) / matrix, self.saturation)

    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Apply the fit."""
        matrix, offset = self._fit(rows)
        if self.form == "affine":
            return (matrix @ executed.unsqueeze(-1)).squeeze(-1) + offset
        return matrix * executed + offset

    def _fit(self, rows: Rows) -> tuple[Tensor, Tensor]:
        """Return matrix or gains, and offset."""
        executed, effective, std, valid = rows
        weight = weigh(valid, self.forgetting)
        if self.form == "affine":
            return fit_affine(executed, effective, weight)
        weight = weight / (1 + (std / NOISE).square())
        if self.form == "gain":
            gain = not_zero(fit_gain(executed, effective, weight))
            return gain, torch.zeros_like(gain)
        return fit_line(executed, effective, weight)


class L1Augmentation(ClassicalCorrector):
    r"""L1 adaptive augmentation: what the model cannot explain is an additive disturbance.

    .. math:: u = u_0 - C(s)\,\hat\sigma,\qquad
              \hat\sigma_k = u_{\mathrm{eff},k} - u_k,\qquad C(s) = \frac{\omega}{s + \omega}

    with the planned action :math:`u_0`, saturated. The piecewise-constant adaptation law for a
    state predictor with error dynamics :math:`A_s` answers with :math:`e^{A_s \Delta t}` times
    the mean disturbance of the last tick. Here the predictor starts from the measured state at
    each tick, the limit :math:`A_s \to 0`, and that disturbance is read from the model's
    one-tick error (:func:`~afm_rl.dynamics.inverse.effective_action`): any model and robot will
    do, and what no action can do (the unmatched part) is left out. Unlike in the literature
    there is a gate, and the filter remembers K ticks only: :math:`e^{-K \omega \Delta t}` of a
    lasting disturbance is missed.

    A gain g is a disturbance :math:`(g - 1) u`, which is countered as long as
    :math:`0 < g < 2 / (1 - e^{-\omega \Delta t})`: nothing here can follow a reversed motor.

    Hovakimyan and Cao, L1 Adaptive Control Theory (2010), chapter 3; Hanover et al.,
    Performance, Precision, and Payloads (2021), who augment model predictive control.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.

    >>> L1Augmentation(torch.tensor([-1.0]), torch.tensor([1.0]), dt=0.2).memory
    24
    """

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        dt: Annotated[Positive, "control tick, s"],
        bandwidth: Annotated[Positive, "cut-off omega of the low-pass, rad/s"] = 5.0,
        window: int = 24,
        gate: float = 5.0,
        saturation: Saturation = "clip",
    ) -> None:
        super().__init__(action_low, action_high, window, gate, saturation)
        self.dt, self.bandwidth = dt, bandwidth

    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Take the disturbance off."""
        return saturate(planned - self._disturbance(rows), self.saturation)

    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Add the disturbance."""
        return executed + self._disturbance(rows)

    def _disturbance(self, rows: Rows) -> Tensor:
        return low_pass(rows.effective - rows.executed, rows.valid, self.bandwidth, self.dt)


def low_pass(signal: Tensor, valid: Tensor, bandwidth: float, dt: float) -> Tensor:
    r"""Return where a first-order low-pass has come to, K ticks after it was at zero.

    .. math:: \hat d_k = e^{-\omega \Delta t}\,\hat d_{k-1} + (1 - e^{-\omega \Delta t})\,d_k

    is :math:`C(s) = \omega / (s + \omega)`, exactly, for a signal that is held for each tick.

    Args:
        signal: d, ``(*B, K, A)``, oldest first.
        valid: which ticks count, ``(*B, K, 1)``, 0 or 1; the others are taken for zero.
        bandwidth: :math:`\omega` (rad/s).
        dt: :math:`\Delta t`, the tick (s).

    Returns:
        ``(*B, A)``.

    >>> low_pass(torch.ones(3, 1), torch.ones(3, 1), math.log(2.0), dt=1.0)
    tensor([0.8750])
    """
    keep = math.exp(-bandwidth * dt)
    return (1.0 - keep) * (weigh(valid, keep) * signal).sum(-2)


def weigh(valid: Tensor, forgetting: float) -> Tensor:
    r"""Return the weight of each row ``(*B, K, 1)``: :math:`\lambda^k` at age k, if it counts.

    >>> weigh(torch.ones(3, 1), 0.5).squeeze(-1)
    tensor([0.2500, 0.5000, 1.0000])
    """
    age = torch.arange(valid.shape[-2] - 1, -1, -1, device=valid.device, dtype=valid.dtype)
    return valid * (forgetting**age).unsqueeze(-1)
