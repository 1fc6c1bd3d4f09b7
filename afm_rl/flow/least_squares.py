"""Least squares with forgetting: the classical adaptive baselines."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.errors import check_choice, check_number
from afm_rl.flow.base import Context
from afm_rl.flow.pairs import PairCorrector
from afm_rl.flow.saturation import MODES, saturate

PRIOR, LEAST = 1e-3, 0.02  # pull towards the nominal fit, and the smallest gain divided by


def _weights(valid: Tensor, forgetting: float) -> Tensor:
    window = valid.shape[-2]
    age = torch.arange(window - 1, -1, -1, device=valid.device, dtype=valid.dtype)
    return valid * (forgetting**age).unsqueeze(-1)


def fit_gain(executed: Tensor, effective: Tensor, valid: Tensor, forgetting: float) -> Tensor:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u`, each axis for itself.

    .. math:: g = \frac{\sum_k \lambda^k u_k u_{\mathrm{eff},k} + \rho}
                        {\sum_k \lambda^k u_k^2 + \rho}

    with k the age of a pair and a small ridge towards gain 1.

    Args:
        executed: u, ``(*B, K, A)``, oldest first.
        effective: what it was worth, ``(*B, K, A)``.
        valid: which pairs count, ``(*B, K, 1)``, 0 or 1.
        forgetting: :math:`\lambda` in (0, 1].

    Returns:
        Gains ``(*B, A)``, none smaller than 0.02 in size.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, torch.ones(2, 1), 0.8).round(decimals=2)
    tensor([-2.])
    """
    weight = _weights(valid, forgetting)
    cross = (weight * executed * effective).sum(-2) + PRIOR
    gain = cross / ((weight * executed.square()).sum(-2) + PRIOR)
    return torch.where(gain.abs() < LEAST, torch.where(gain < 0, -LEAST, LEAST), gain)


def fit_affine(
    executed: Tensor, effective: Tensor, valid: Tensor, forgetting: float
) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a small ridge towards D = 1, b = 0.

    Args and shapes as for :func:`fit_gain`.

    Returns:
        D ``(*B, A, A)`` and b ``(*B, A)``.
    """
    weight = _weights(valid, forgetting)
    inputs = torch.cat([executed, torch.ones_like(executed[..., :1])], -1)
    size = inputs.shape[-1]
    nominal = torch.eye(size, device=inputs.device, dtype=inputs.dtype)
    gram = (weight * inputs).mT @ inputs + PRIOR * nominal
    cross = (weight * inputs).mT @ effective + PRIOR * nominal[:, :-1]
    solution = torch.linalg.solve(gram, cross).mT  # (*B, A, A + 1)
    return solution[..., :-1], solution[..., -1]


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
        saturation: ``"clip"``, as is customary, or ``"direction"``.

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
        self.form = check_choice("flow.form", form, ("gain", "affine"))
        self.forgetting = check_number(
            "flow.forgetting", forgetting, low=0.0, high=1.0, open_low=True
        )
        self.saturation = check_choice("flow.saturation", saturation, MODES)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> tuple[Tensor, Tensor]:
        """Invert the fit; the spread is zero."""
        unit, pairs = self.normalise(planned), self.pairs(context.features)
        if self.form == "gain":
            wanted = unit / fit_gain(*pairs, self.forgetting)
        else:
            matrix, bias = fit_affine(*pairs, self.forgetting)
            ridge = LEAST**2 * torch.eye(self.action_size).to(unit)
            target = matrix.mT @ (unit - bias).unsqueeze(-1)
            wanted = torch.linalg.solve(matrix.mT @ matrix + ridge, target).squeeze(-1)
        executed = self.denormalise(saturate(wanted, self.saturation))
        return executed, torch.zeros_like(executed)
