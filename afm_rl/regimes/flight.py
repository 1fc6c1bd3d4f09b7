r"""What can change about a quadrotor, as effective nominal actions.

Actions are :math:`u = (T, M_x, M_y, M_z)` in N and N m, as the motors give them. Each family is
exact: the nominal body under the effective action moves as the changed body does under u.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import Regime, check_span, draw_between, same_command
from afm_rl.regimes.compose import Compose
from afm_rl.regimes.gains import ActionGain, divide
from afm_rl.spaces.airframe import QuadrotorBody, mix, unmix

MOST = 100.0  # factors beyond are typing errors


class _Divisor(Regime):
    """A factor that divides some components of the action."""

    identity = (1.0,)
    divided: tuple[bool, bool, bool, bool]

    def __init__(self, span: Sequence[float] | None = None) -> None:
        least, most = 0.01, MOST
        self.limits = {self.names[0]: (least, most)}
        self.span = check_span("span", self.span if span is None else span, least, most)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action / self._divisors(parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        return effect * self._divisors(parameters)

    def _divisors(self, factor: Tensor) -> Tensor:
        one = torch.ones_like(factor)
        return torch.cat([factor if divided else one for divided in self.divided], -1)


class MassFactor(_Divisor):
    r"""Another mass, c m: :math:`v' = g + T / (c m)\,b_3`. The inertia stays what it is.

    Args:
        span: lowest and highest factor c in the prior, uniform.

    >>> light = MassFactor()
    >>> light.apply(torch.tensor([0.3, 0, 0, 0]), light.encode({"mass": 0.5}), torch.zeros(13))
    tensor([0.6000, 0.0000, 0.0000, 0.0000])
    """

    names = ("mass",)
    span = (0.5, 1.5)
    divided = (True, False, False, False)


class InertiaFactor(_Divisor):
    r"""Other moments of inertia, c J: :math:`\omega' = J^{-1} (M / c - \omega \times J \omega)`.

    Args:
        span: lowest and highest factor c in the prior, uniform.

    >>> heavy = InertiaFactor()
    >>> row = heavy.encode({"inertia": 2.0})
    >>> heavy.apply(torch.tensor([0.3, 0.002, 0, 0]), row, torch.zeros(13))
    tensor([0.3000, 0.0010, 0.0000, 0.0000])
    """

    names = ("inertia",)
    span = (0.5, 2.0)
    divided = (False, True, True, True)


class MotorEfficiency(Regime):
    r"""Motors of which each gives a share :math:`\eta_i` of its thrust and drag.

    .. math:: u_\mathrm{eff} = X\,\mathrm{diag}(\eta)\,X^{-1} u

    X is the mixer, :func:`~afm_rl.spaces.airframe.mix`.

    Args:
        body: the quadrotor, a Crazyflie if None.
        span: lowest and highest share in the prior, uniform.

    >>> worn = MotorEfficiency()
    >>> row = worn.encode({"motor_1": 0.5, "motor_3": 0.5})
    >>> worn.apply(torch.tensor([0.4, 0, 0, 0]), row, torch.zeros(13))[0]
    tensor(0.3000)
    """

    names = ("motor_1", "motor_2", "motor_3", "motor_4")
    identity = (1.0, 1.0, 1.0, 1.0)
    limits = dict.fromkeys(names, (0.0, 1.0))

    def __init__(
        self, body: QuadrotorBody | None = None, span: Sequence[float] = (0.7, 1.0)
    ) -> None:
        self.body = QuadrotorBody() if body is None else body
        self.span = check_span("span", span, 0.0, 1.0)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action + mix(unmix(action, self.body) * (parameters - 1), self.body)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Ask each motor for more; nothing is asked of one that stands still."""
        forces = unmix(effect, self.body)
        return effect + mix(divide(forces, parameters) - forces, self.body)


class Payload(Regime):
    r"""A small load of mass p m, fixed at (x, y) in the plane of the rotors.

    The centre of mass moves to :math:`d = p / (1 + p)\,(x, y)`; the thrust has a moment about it:

    .. math:: T_\mathrm{eff} = \frac{T}{1 + p},\qquad M_\mathrm{eff} = M + T (-d_y, d_x, 0)

    In hover that moment is :math:`r \times F_g`, what the load's weight does about the centre of
    the rotors. The state is that of the new centre of mass, and the inertia stays what it is.

    Args:
        share: lowest and highest p in the prior, uniform.
        offset: lowest and highest x and y (m) in the prior, uniform.

    >>> load = Payload()
    >>> row = load.encode({"payload": 0.25, "payload_x": 0.01})
    >>> load.apply(torch.tensor([0.5, 0, 0, 0]), row, torch.zeros(13))
    tensor([0.4000, 0.0000, 0.0010, 0.0000])
    """

    names = ("payload", "payload_x", "payload_y")
    identity = (0.0, 0.0, 0.0)
    limits = {"payload": (0.0, MOST)}

    def __init__(
        self, share: Sequence[float] = (0.0, 0.5), offset: Sequence[float] = (-0.01, 0.01)
    ) -> None:
        self.share = check_span("share", share, 0.0, MOST)
        self.offset = check_span("offset", offset)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        thrust = action[..., :1]
        return action / self._weight(parameters) + thrust * self._levers(parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        needed = effect * self._weight(parameters)
        return needed - needed[..., :1] * self._levers(parameters)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        share = draw_between(self.share, (*shape, 1), generator)
        return torch.cat([share, draw_between(self.offset, (*shape, 2), generator)], -1)

    def _weight(self, parameters: Tensor) -> Tensor:
        share = parameters[..., :1]
        one = torch.ones_like(share)
        return torch.cat([1 + share, one, one, one], -1)

    def _levers(self, parameters: Tensor) -> Tensor:
        share, x, y = parameters.split(1, -1)
        moved, none = share / (1 + share), torch.zeros_like(share)
        return torch.cat([none, -moved * y, moved * x, none], -1)


class Wind(Regime):
    """A steady wind, as an acceleration (m/s^2) in the world frame.

    No action does what it does, so :meth:`apply` leaves the action alone: simulators ask
    :func:`wind_of` for it.

    Args:
        span: lowest and highest acceleration per axis in the prior, uniform.

    >>> wind = Wind()
    >>> wind_of(wind, wind.encode({"wind_x": -1.5}))
    tensor([-1.5000,  0.0000,  0.0000])
    """

    names = ("wind_x", "wind_y", "wind_z")
    identity = (0.0, 0.0, 0.0)
    command_for = same_command

    def __init__(self, span: Sequence[float] = (-1.0, 1.0)) -> None:
        self.span = check_span("span", span)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action


def wind_of(regime: Regime, parameters: Tensor) -> Tensor | None:
    """Return the wind's acceleration ``(*B, 3)`` in m/s^2, None if the family has no wind.

    >>> wind_of(MassFactor(), torch.ones(1)) is None
    True
    """
    if not set(Wind.names) <= set(regime.names):
        return None
    columns = [regime.names.index(name) for name in Wind.names]
    return torch.stack([parameters[..., column] for column in columns], -1)


def flight_regimes(body: QuadrotorBody | None = None) -> Compose:
    """Return all that can change about a quadrotor; a draw changes one of them.

    The families are ``motors``, ``gain``, ``payload``, ``mass``, ``inertia`` and ``wind``, in
    the order in which they act. Gains, which may have either sign, are not in the prior.

    >>> flight_regimes().encode({"mass": 0.5, "wind_x": 1.0}).shape
    torch.Size([16])
    """
    gains = ActionGain(["thrust_gain", "roll_gain", "pitch_gain", "yaw_gain"])
    families: dict[str, Regime] = {
        "motors": MotorEfficiency(body),
        "gain": gains,
        "payload": Payload(),
        "mass": MassFactor(),
        "inertia": InertiaFactor(),
        "wind": Wind(),
    }
    return Compose(families, prior=[[name] for name in families if name != "gain"])
