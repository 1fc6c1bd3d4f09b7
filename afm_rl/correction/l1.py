"""L1 adaptive augmentation: the disturbance of the last moments, filtered and taken off."""

from __future__ import annotations

import math

import torch  # noqa: F401, for the examples
from torch import Tensor

from afm_rl.correction.achievable import MODES, saturate
from afm_rl.correction.classical import ClassicalCorrector
from afm_rl.correction.experts import Rows
from afm_rl.correction.fits import weigh
from afm_rl.errors import check_choice, check_number


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
        dt: control tick (s).
        bandwidth: of the low-pass, :math:`\omega` (rad/s).
        window: transitions that can be remembered, K.
        gate: innovation at which it does nothing, in standard deviations that the model states.
        saturation: ``"clip"``, as is customary, ``"direction"`` or ``"mixed"``.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> L1Augmentation(torch.tensor([-1.0]), torch.tensor([1.0]), dt=0.2).memory
    24
    """

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        dt: float,
        bandwidth: float = 5.0,
        window: int = 24,
        gate: float = 5.0,
        saturation: str = "clip",
    ) -> None:
        super().__init__(action_low, action_high, gate, window)
        self.dt = check_number("corrector.dt", dt, low=0.0, open_low=True)
        self.bandwidth = check_number("corrector.bandwidth", bandwidth, low=0.0, open_low=True)
        self.saturation = check_choice("corrector.saturation", saturation, MODES)

    def inverse(self, rows: Rows, planned: Tensor) -> Tensor:
        """Take the disturbance off."""
        return saturate(planned - self._disturbance(rows), self.saturation)

    def effect(self, rows: Rows, executed: Tensor) -> Tensor:
        """Add the disturbance."""
        return executed + self._disturbance(rows)

    def _disturbance(self, rows: Rows) -> Tensor:
        return low_pass(rows.effective - rows.executed, rows.valid, self.bandwidth, self.dt)
