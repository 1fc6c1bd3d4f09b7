"""Least squares with forgetting: the classical adaptive baselines."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.correction.achievable import MODES, saturate
from afm_rl.correction.classical import ClassicalCorrector
from afm_rl.correction.experts import Rows
from afm_rl.correction.fits import (
    confidence,
    fit_affine,
    fit_gain,
    fit_gain_offset,
    invert_affine,
    weigh,
)
from afm_rl.errors import check_choice, check_number

FORMS = ("gain", "gain_offset", "affine")


class LeastSquares(ClassicalCorrector):
    r"""Certainty-equivalent adaptive control: fit the regime, execute the inverse.

    Executes :math:`g^{-1} u_0` (``form="gain"``), :math:`g^{-1} (u_0 - b)` with a robust fit
    (``"gain_offset"``, :func:`~afm_rl.correction.fits.fit_gain_offset`) or :math:`D^{-1} (u_0 - b)`
    (``"affine"``), saturated. Pairs count by their age and, all but ``"affine"``, by their noise.
    Nothing is trained; any control engineer's first answer, and the bar for a learned flow.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        form: ``"gain"`` or ``"gain_offset"``, each axis for itself, or ``"affine"``.
        window: transitions that are remembered, K.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: innovation at which it does nothing, in standard deviations that the model states.
        saturation: ``"clip"``, as is customary, ``"direction"`` or ``"mixed"``.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> LeastSquares(torch.tensor([-1.0]), torch.tensor([1.0])).memory
    24
    """

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        form: str = "gain",
        window: int = 24,
        forgetting: float = 0.8,
        gate: float = 5.0,
        saturation: str = "clip",
    ) -> None:
        super().__init__(action_low, action_high, gate, window)
        self.form = check_choice("corrector.form", form, FORMS)
        self.forgetting = check_number(
            "corrector.forgetting", forgetting, low=0.0, high=1.0, open_low=True
        )
        self.saturation = check_choice("corrector.saturation", saturation, MODES)

    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Invert the fit."""
        matrix, offset = self._fit(rows)
        if self.form == "affine":
            return saturate(invert_affine(matrix, offset, planned), self.saturation)
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
        weight = weight * confidence(std)
        if self.form == "gain":
            gain = fit_gain(executed, effective, weight)
            return gain, torch.zeros_like(gain)
        return fit_gain_offset(executed, effective, weight)
