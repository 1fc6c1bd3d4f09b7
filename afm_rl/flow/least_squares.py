"""Least squares with forgetting: the classical adaptive baselines."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.errors import check_choice, check_number
from afm_rl.flow.base import Context, Correction
from afm_rl.flow.pairs import PairCorrector
from afm_rl.flow.saturation import MODES, saturate

STUCK = 5e-3  # half ranges: an action with less effect is held by friction
PRIOR, LEAST = 1e-3, 0.02  # pull towards the nominal fit, and the smallest gain divided by


def weigh(valid: Tensor, forgetting: float) -> Tensor:
    r"""Return the weight of each pair ``(*B, K, 1)``: :math:`\lambda^k` at age k, if it counts.

    >>> weigh(torch.ones(3, 1), 0.5).squeeze(-1)
    tensor([0.2500, 0.5000, 1.0000])
    """
    window = valid.shape[-2]
    age = torch.arange(window - 1, -1, -1, device=valid.device, dtype=valid.dtype)
    return valid * (forgetting**age).unsqueeze(-1)


def fit_gain(executed: Tensor, effective: Tensor, weight: Tensor) -> Tensor:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u`, each axis for itself.

    .. math:: g = \frac{\sum_k w_k u_k u_{\mathrm{eff},k} + \rho}
                        {\sum_k w_k u_k^2 + \rho}

    with a small ridge towards gain 1.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: what it was worth, ``(*B, K, A)``.
        weight: how much pairs count, ``(*B, K, 1)``, see :func:`weigh`.

    Returns:
        Gains ``(*B, A)``, none smaller than 0.02 in size.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, weigh(torch.ones(2, 1), 0.8)).round(decimals=2)
    tensor([-2.])
    """
    cross = (weight * (executed * effective)).sum(-2) + PRIOR
    return _not_zero(cross / ((weight * executed.square()).sum(-2) + PRIOR))


def fit_friction(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u + h \odot \mathrm{sign}(u)`, each axis for itself.

    Dry friction, or a dead zone: pairs without any effect are left out, see
    :func:`apply_friction`. Args and shapes as for :func:`fit_gain`, with a ridge towards g = 1,
    h = 0.

    Returns:
        Gains, none smaller than 0.02 in size, and offsets, ``(*B, A)`` each.
    """
    size, sign = executed.abs(), executed.sign()
    terms = [size * size, size, sign.abs(), executed * effective, sign * effective]
    moved = weight * (effective.abs() > STUCK)
    square, mixed, signs, cross, signed = (moved * torch.stack(terms)).sum(-2)
    square, cross = square + PRIOR, cross + PRIOR
    signs = signs + 10 * PRIOR  # the offset is the rarer of the two
    determinant = (square * signs - mixed.square()).clamp_min(PRIOR**2)
    gain = (signs * cross - mixed * signed) / determinant
    return _not_zero(gain), (square * signed - mixed * cross) / determinant


def apply_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return what ``unit`` ``(*B, A)`` is worth under :func:`fit_friction`: zero if it is held.

    >>> apply_friction(torch.tensor(1.0), torch.tensor(-0.5), torch.tensor([-0.7, 0.2])).tolist()
    [-0.19999998807907104, 0.0]
    """
    pull = gain * unit
    worth = pull + offset * unit.sign()
    return torch.where(worth * pull < 0, 0.0, worth)


def invert_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` that has the effect ``unit`` under :func:`fit_friction`."""
    return (unit - offset * (unit / gain).sign()) / gain


def _not_zero(gain: Tensor) -> Tensor:
    return gain.abs().clamp_min(LEAST).copysign(gain)


def fit_affine(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a small ridge towards D = 1, b = 0.

    Args and shapes as for :func:`fit_gain`.

    Returns:
        D ``(*B, A, A)`` and b ``(*B, A)``.
    """
    inputs = torch.nn.functional.pad(executed, (0, 1), value=1.0)
    size = inputs.shape[-1]
    nominal = torch.eye(size, device=inputs.device, dtype=inputs.dtype)
    moments = (weight * inputs).mT @ torch.cat([inputs, effective], -1)
    moments = moments + PRIOR * torch.cat([nominal, nominal[:, :-1]], -1)
    solution = torch.linalg.solve(moments[..., :size], moments[..., size:]).mT  # (*B, A, A + 1)
    return solution[..., :-1], solution[..., -1]


def invert_affine(matrix: Tensor, bias: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` whose effect under :func:`fit_affine` is nearest to ``unit``.

    A small ridge keeps it finite where the matrix is all but singular.
    """
    ridge = LEAST**2 * torch.eye(unit.shape[-1], device=unit.device, dtype=unit.dtype)
    target = (matrix * (unit - bias).unsqueeze(-1)).sum(-2, keepdim=True).mT
    return torch.linalg.solve(matrix.mT @ matrix + ridge, target).squeeze(-1)


class LeastSquares(PairCorrector):
    r"""Certainty-equivalent adaptive control: fit the regime, execute the inverse.

    Executes :math:`g^{-1} u_0` (``form="gain"``) or :math:`D^{-1} (u_0 - b)`
    (``form="affine"``), saturated. Nothing is trained; any control engineer's first answer,
    and the bar for a learned flow.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        form: ``"gain"``, each axis for itself, or ``"affine"``.
        window: transitions that can be remembered, K.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: in standard deviations of the model.
        saturation: ``"clip"``, as is customary, ``"direction"`` or ``"mixed"``.

    >>> LeastSquares(torch.tensor([-1.0]), torch.tensor([1.0])).feature_size
    72
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
        super().__init__(action_low, action_high, window, gate)
        self.form = check_choice("corrector.form", form, ("gain", "affine"))
        self.forgetting = check_number(
            "corrector.forgetting", forgetting, low=0.0, high=1.0, open_low=True
        )
        self.saturation = check_choice("corrector.saturation", saturation, MODES)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Invert the fit, which also tells the effect; the spread is zero."""
        unit = self.normalise(planned)
        executed, effective, valid = self.pairs(context.features)
        pairs = executed, effective, weigh(valid, self.forgetting)
        if self.form == "gain":
            gain = fit_gain(*pairs)
            found = saturate(unit / gain, self.saturation)
            expected = gain * found
        else:
            matrix, bias = fit_affine(*pairs)
            found = saturate(invert_affine(matrix, bias, unit), self.saturation)
            expected = (matrix @ found.unsqueeze(-1)).squeeze(-1) + bias
        action = self.denormalise(found)
        nothing = torch.zeros_like(action)
        return Correction(action, nothing, expected=self.denormalise(expected))
