"""Actuators of another strength: gains, losses, offsets, noise."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number
from afm_rl.options import Positive, Share, options
from afm_rl.regimes.base import MOST, HalfRange, Regime, check_span, draw_between, same_command

MOST_GAIN = 100.0  # gains beyond are typing errors


class GainRegime(Regime):
    """A regime that multiplies actions; subclasses implement :meth:`gains`.

    The command for an effect divides by the gains; a gain of zero leaves nothing to choose, and
    its command is zero.
    """

    @abstractmethod
    def gains(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        """Return the gains ``(*B, A)`` of actions, or of effects of the same sign."""

    def of_each(self, action: Tensor, gains: Tensor) -> Tensor:
        """Return the gains, if there is one for each action."""
        if action.shape[-1] != gains.shape[-1]:
            raise ConfigurationError(
                f"{type(self).__name__} with parameters {', '.join(self.names)}: the robot has "
                f"{action.shape[-1]} actions; give one name for each"
            )
        return gains

    def effect_of(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        return action * self.gains(action, parameters, *state)

    def command_for(self, effect: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        return divide(effect, self.gains(effect, parameters, *state))


class ActionGain(GainRegime):
    r"""Per-axis gains: :math:`a_\mathrm{eff} = g \odot a` (paper, section V-B).

    The prior draws each gain's size log-uniformly, its sign at random, and leaves an axis
    nominal with probability ``nominal``.

    Args:
        names: one parameter name per action axis.

    >>> gains = ActionGain(["v_gain", "omega_gain"])
    >>> row = gains.encode({"v_gain": -1.7})
    >>> gains.apply(torch.tensor([0.5, 1.0]), row, torch.zeros(3))
    tensor([-0.8500,  1.0000])
    """

    @options("")
    def __init__(
        self,
        names: Sequence[str],
        low: Annotated[Positive, "smallest gain in the prior, log-uniform, any sign"] = 0.05,
        high: Annotated[Positive, "largest gain in the prior"] = 3.0,
        nominal: Annotated[Share, "probability that the gain of an axis does not change"] = 0.25,
    ) -> None:
        self.names = self.distinct(names)
        self.identity = (1.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (-MOST_GAIN, MOST_GAIN))
        if low > high:
            raise ConfigurationError(f"low={low!r}: expected at most high={high!r}")
        self.low, self.high, self.nominal = low, high, nominal

    def gains(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        return self.of_each(action, parameters)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        size = (*shape, len(self.names))
        uniform = torch.rand((3, *size), generator=generator)
        span = math.log(self.high / self.low)
        gains = self.low * torch.exp(span * uniform[0]) * torch.where(uniform[1] < 0.5, -1.0, 1.0)
        return torch.where(uniform[2] < self.nominal, 1.0, gains)


def divide(action: Tensor, gains: Tensor) -> Tensor:
    """Undo gains; one of zero leaves nothing to choose and gives zero.

    >>> divide(torch.tensor([1.0, 1.0]), torch.tensor([-2.0, 0.0]))
    tensor([-0.5000,  0.0000])
    """
    return torch.where(gains == 0, 0.0, action / gains)


class AsymmetricGain(GainRegime):
    r"""One gain for commands above zero and another one for those below, on each axis.

    .. math:: a_\mathrm{eff} = \begin{cases} g^+ a & a > 0 \\ g^- a & \text{otherwise}\end{cases}

    Gains are not negative: combine it with :class:`~afm_rl.regimes.ActionGain` to reverse an
    axis. The prior draws both gains of an axis log-uniformly.

    Args:
        names: one name per action axis; its parameters are ``NAME_up`` and ``NAME_down``.
        span: lowest and highest gain in the prior, > 0.

    >>> worn = AsymmetricGain(["v"])
    >>> row = worn.encode({"v_down": 0.5})
    >>> worn.apply(torch.tensor([[1.0], [-1.0]]), row, torch.zeros(3))
    tensor([[ 1.0000],
            [-0.5000]])
    """

    def __init__(self, names: Sequence[str], span: Sequence[float] = (0.3, 1.5)) -> None:
        axes = self.distinct(names)
        self.names = tuple(f"{axis}_{way}" for way in ("up", "down") for axis in axes)
        self.identity = (1.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (0.0, MOST_GAIN))
        low, high = check_span("span", span, 0.0, MOST_GAIN)
        check_number("span", low, low=0.0, open_low=True)
        self.span = math.log(low), math.log(high)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        return draw_between(self.span, (*shape, len(self.names)), generator).exp()

    def gains(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        up, down = parameters.chunk(2, -1)
        return torch.where(action > 0, self.of_each(action, up), down)


class DeadActuator(GainRegime):
    r"""Loss of effectiveness: :math:`a_\mathrm{eff} = (1 - l) \odot a`; 1 is a dead actuator.

    The prior kills one axis and leaves the others nominal.

    Args:
        names: one parameter name per action axis.

    >>> dead = DeadActuator(["left_loss", "right_loss"])
    >>> dead.apply(torch.ones(2), dead.encode({"left_loss": 1.0}), torch.zeros(3))
    tensor([0., 1.])
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = self.distinct(names)
        self.identity = (0.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (0.0, 1.0))

    def gains(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        return 1 - self.of_each(action, parameters)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        axis = torch.randint(len(self.names), shape, generator=generator)
        return torch.nn.functional.one_hot(axis, len(self.names)).float()


class GainNoise(Regime):
    r"""Gains that are drawn again at each step, the same spread on all axes.

    .. math:: a_\mathrm{eff} = a\,(1 + \sigma \epsilon), \quad \epsilon \sim N(0, I)

    Without noise to draw on, the effect is its mean: the action.

    Args:
        span: lowest and highest standard deviation in the prior, uniform.

    >>> import torch
    >>> shaky, noise = GainNoise(), torch.tensor([1.0, -2.0])
    >>> shaky.apply(torch.ones(2), shaky.encode({"gain_noise": 0.25}), torch.zeros(3), noise=noise)
    tensor([1.2500, 0.5000])
    """

    names = ("gain_noise",)
    identity = (0.0,)
    limits = {"gain_noise": (0.0, MOST)}
    noisy = True
    command_for = same_command

    def __init__(self, span: Sequence[float] = (0.1, 0.5)) -> None:
        self.span = check_span("span", span, 0.0, MOST)

    def effect_of(self, action: Tensor, parameters: Tensor, noise: Tensor) -> Tensor:
        return action * (1 + parameters * noise)


class Bias(Regime):
    r"""Per-axis offsets: :math:`a_\mathrm{eff} = a + b \odot h`.

    Args:
        names: one parameter name per action axis.
        half_range: half ranges h of the action axes, the unit of the offsets b.
        span: lowest and highest offset in the prior, uniform.

    >>> import torch
    >>> bias = Bias(["v_bias", "omega_bias"], half_range=[1.0, 2.0])
    >>> bias.apply(torch.zeros(2), bias.encode({"omega_bias": 0.25}), torch.zeros(3))
    tensor([0.0000, 0.5000])
    """

    def __init__(
        self,
        names: Sequence[str],
        half_range: Sequence[float],
        span: Sequence[float] = (-0.4, 0.4),
    ) -> None:
        self.half_range = HalfRange(half_range)
        self.names = self.distinct(names, len(self.half_range.values))
        self.limits = dict.fromkeys(self.names, (-MOST, MOST))
        self.identity = (0.0,) * len(self.names)
        self.span = check_span("span", span)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action + parameters * self.half_range.like(action)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        return effect - parameters * self.half_range.like(effect)
