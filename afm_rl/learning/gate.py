"""The gate of a corrector over a learned model, fitted to a rate of false alarms."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, NonFiniteError, check_number
from afm_rl.spaces.keys import as_keys


@torch.no_grad()
def largest_innovation(
    model: DynamicsModel, state: Tensor, action: Tensor, next_state: Tensor
) -> Tensor:
    r"""Return the largest normalised innovation of transitions over coordinates, ``(*B)``.

    .. math:: \max_d |s_{t+1} \ominus f(s_t, a_t)|_d / \sigma_d(s_t, a_t)

    Args:
        model: f and its noise scale :math:`\sigma`.
        state: ``(*B, S)``.
        action: the executed action, ``(*B, A)``.
        next_state: ``(*B, S)``.

    >>> from afm_rl.dynamics import Dubins
    >>> s, a = torch.zeros(3), torch.tensor([0.5, 0.2])
    >>> largest_innovation(Dubins(noise_std=0.01), s, a, Dubins()(s, a) + 0.02).round(decimals=3)
    tensor(2.)
    """
    expected, noise = model.forecast(state, action)
    return (model.manifold.difference(next_state, expected).abs() / noise).amax(-1)


def fit_gate(
    corrector: Any,
    model: DynamicsModel,
    transitions: TensorDictBase,
    false_alarms: float = 0.01,
    *,
    keys: tuple[NestedKey, NestedKey, NestedKey] = (
        "observation",
        "action",
        ("next", "observation"),
    ),
) -> float:
    r"""Set the gate of a corrector so that it opens by mistake at a chosen rate; return the gate.

    A learned model's own standard deviation is too small in some places and its errors have heavy
    tails: a gate of five of them opens far too often. The gate is set to a quantile of what the
    corrector looks at, the largest innovation of its newest R transitions, over healthy data: of
    N values the :math:`\lceil (N + 1)(1 - \alpha) \rceil`-th smallest (split conformal
    prediction, Vovk et al. 2005).

    Args:
        corrector: anything with a ``gate`` in standard deviations of the model's noise and the
            number ``recent`` of newest transitions that it looks at (1 if it has none).
        model: the fitted model.
        transitions: healthy ones ``(*B, T)``, in the order of time along the last dimension. The
            model must not have been fitted to them: its errors would be too small.
        false_alarms: share :math:`\alpha` of healthy steps at which the gate opens, in (0, 0.5].
        keys: where state, executed action and next state are.

    Raises:
        ConfigurationError: if there are too few transitions for such a rate.
        NonFiniteError: if an innovation is not finite.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.correction import LeastSquares
    >>> model, least_squares = Dubins(noise_std=0.01), LeastSquares(-torch.ones(2), torch.ones(2))
    >>> s, a = torch.zeros(5000, 3), torch.ones(5000, 2)
    >>> noisy = model(s, a) + 0.05 * torch.randn(5000, 3)  # five times what the model admits
    >>> healthy = TensorDict({"observation": s, "action": a}, [5000])
    >>> healthy = healthy.set(("next", "observation"), noisy)
    >>> 12 < fit_gate(least_squares, model, healthy) < 25
    True
    """
    check_number("false_alarms", false_alarms, low=0.0, high=0.5, open_low=True)
    state, action, after = (transitions.get(key) for key in as_keys(keys))
    innovation = largest_innovation(model, state, action, after)
    recent = getattr(corrector, "recent", 1)
    if innovation.shape[-1] < recent:
        raise ConfigurationError(
            f"transitions of shape {tuple(innovation.shape)}: expected at least {recent} steps, "
            "as many as the corrector looks at"
        )
    newest = innovation.unfold(-1, recent, 1).amax(-1).flatten().sort().values
    if not bool(newest[-1].isfinite()):
        raise NonFiniteError("transitions: an innovation is not finite")
    index = math.ceil((len(newest) + 1) * (1 - false_alarms))
    if index > len(newest):
        raise ConfigurationError(
            f"false_alarms={false_alarms}: expected at least {math.ceil(1 / false_alarms)} "
            f"windows of {recent} healthy steps, got {len(newest)}"
        )
    corrector.gate = float(newest[index - 1])
    return corrector.gate
