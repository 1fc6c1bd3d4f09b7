"""What can happen to the actuators of any robot."""

from __future__ import annotations

from collections.abc import Sequence

from afm_rl.regimes.asymmetric import AsymmetricGain
from afm_rl.regimes.backlash import Backlash
from afm_rl.regimes.base import Regime
from afm_rl.regimes.bias import Bias
from afm_rl.regimes.dead import DeadActuator
from afm_rl.regimes.dead_zone import DeadZone
from afm_rl.regimes.delay import Delay
from afm_rl.regimes.gain import ActionGain
from afm_rl.regimes.gain_noise import GainNoise
from afm_rl.regimes.lag import Lag
from afm_rl.regimes.permutation import Permutation
from afm_rl.regimes.quantisation import Quantisation
from afm_rl.regimes.saturation import Saturation


def actuator_regimes(low: Sequence[float], high: Sequence[float]) -> dict[str, Regime]:
    """Return families for A actuators, by name, in the order in which they act.

    Parameters of single actuators end in their index: ``gain_0``, ``bias_0``, ``from_0`` (which
    command actuator 0 gets), ``gain_0_up`` and ``gain_0_down`` (by direction), ``loss_0`` (share
    of its effect that is lost). Those of all are ``delay``, ``lag``, ``backlash``, ``quantum``,
    ``saturation``, ``dead_zone`` and ``gain_noise``.

    Args:
        low: lowest action, ``(A,)``.
        high: highest action, ``(A,)``.

    >>> import torch
    >>> from afm_rl.regimes import Compose
    >>> both = Compose(actuator_regimes([-1.0, -1.0], [1.0, 1.0]))
    >>> swapped = both.encode({"from_0": 1, "from_1": 0, "gain_1": -1.0})
    >>> both.apply(torch.tensor([0.5, 0.2]), swapped, torch.zeros(4))
    tensor([ 0.2000, -0.5000])
    """
    half = [(above - below) / 2 for below, above in zip(low, high, strict=True)]
    axes = range(len(half))
    families: dict[str, Regime] = {
        "delay": Delay(),
        "lag": Lag(),
        "backlash": Backlash(half),
        "permutation": Permutation([f"from_{k}" for k in axes], half),
        "quantisation": Quantisation(half),
        "saturation": Saturation(half),
        "dead_zone": DeadZone(half),
        "gain": ActionGain([f"gain_{k}" for k in axes], low=0.3, high=1.5),
        "asymmetric": AsymmetricGain([f"gain_{k}" for k in axes]),
        "dead": DeadActuator([f"loss_{k}" for k in axes]),
        "gain_noise": GainNoise(),
        "bias": Bias([f"bias_{k}" for k in axes], half, span=(-0.3, 0.3)),
    }
    return families
