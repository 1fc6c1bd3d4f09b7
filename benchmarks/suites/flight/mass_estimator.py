"""A scalar estimate of a quadrotor's mass: the classical baseline."""

from __future__ import annotations

from typing import cast

import roma
import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Oracle, Quadrotor
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.learning.updater import Learner
from afm_rl.spaces.airframe import within_motors


def inverse_mass(
    velocity: Tensor, faster: Tensor, axis: Tensor, thrust: Tensor, dt: float, gravity: float
) -> Tensor:
    r"""Return the inverse of the mass that explains a change of velocity, ``(*B)`` in 1/kg.

    .. math:: k = \frac{(\Delta v + g\,\Delta t\,e_z) \cdot b}{T\,\Delta t\,|b|^2}

    Args:
        velocity: at the start (m/s), ``(*B, 3)``.
        faster: at the end (m/s), ``(*B, 3)``.
        axis: the thrust's mean direction b, ``(*B, 3)``.
        thrust: T (N), ``(*B)``, not 0.
        dt: time in between (s).
        gravity: acceleration of free fall (m/s^2).

    >>> up, still = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
    >>> inverse_mass(still, still, up, torch.tensor(0.2943), 0.05, 9.81)  # it hovers: 30 g
    tensor(33.3333)
    """
    push = faster - velocity
    lift = (push * axis).sum(-1) + gravity * dt * axis[..., 2]
    return lift / (thrust * dt * axis.square().sum(-1))


class MassEstimator(Learner):
    r"""Sets the mass of a model to an estimate from the last changes of velocity.

    :func:`inverse_mass` per tick, low-passed:
    :math:`1/m \leftarrow s\,k + (1 - s) / m`. Nothing else about the flight is estimated.

    Args:
        loss: a loss over an :class:`~afm_rl.dynamics.Oracle` of a
            :class:`~afm_rl.dynamics.Quadrotor` whose regime has a ``mass``, such as
            :class:`~afm_rl.regimes.MassFactor`. It is conditioned on the estimate, not on the true
            mass.
        share: s, weight of the latest measurement, in (0, 1].
        least_thrust: thrust, as a share of the weight, below which nothing is measured.
        least: lowest factor of the nominal mass.
        most: highest one.

    The estimate stays the same at ticks that are refused (:class:`~afm_rl.learning.Learner`) or
    without a finite measurement.

    Raises:
        ConfigurationError: for a setting or model that cannot be used.

    >>> from tensordict import TensorDict
    >>> from afm_rl.regimes import MassFactor
    >>> updater = MassEstimator(GaussianNLLLoss(Oracle(Quadrotor(), MassFactor())), share=1.0)
    >>> level = torch.zeros(2, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> action = torch.tensor([[0.2943, 0, 0, 0], [0.44145, 0, 0, 0]])
    >>> td = TensorDict({"observation": level, "action": action}, [2])
    >>> hovering = level.index_fill(1, torch.tensor(0), 1e-3)  # a bit aside: a fresh reading
    >>> _ = updater(td.set(("next", "observation"), hovering))
    >>> updater.model.parameters_now
    tensor([[1.0000],
            [1.5000]])
    """

    learns, sets = False, "regime"

    def __init__(
        self,
        loss: GaussianNLLLoss,
        share: float = 0.7,
        least_thrust: float = 0.1,
        least: float = 0.1,
        most: float = 10.0,
    ) -> None:
        super().__init__(loss)
        model = loss.model
        if not isinstance(model, Oracle) or not isinstance(model.model, Quadrotor):
            raise ConfigurationError(
                f"updater: MassEstimator needs an Oracle of a Quadrotor, got "
                f"{type(model).__name__}; choose dynamics=oracle and robot=quadrotor"
            )
        if "mass" not in model.regime.names:
            raise ConfigurationError(
                f"updater: the regime has {', '.join(model.regime.names)}: expected a mass"
            )
        self.column = model.regime.names.index("mass")
        self.share = check_number("updater.share", share, low=0.0, high=1.0, open_low=True)
        self.least_thrust = check_number(
            "updater.least_thrust", least_thrust, low=0.0, open_low=True
        )
        self.least = check_number("updater.least", least, low=0.0, open_low=True)
        self.most = check_number("updater.most", most, low=self.least, open_low=True)

    @property
    def model(self) -> Oracle:
        """The model whose mass is set."""
        return cast(Oracle, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Set the nominal mass."""
        super().start()
        if tensordict is not None:
            regime = torch.tensor(self.model.regime.identity)
            self.model.set_regime(regime.expand(*tensordict.batch_size, -1).clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.model.parameters_now.shape[:-1] != tensordict.batch_size:
            self.start(tensordict)
        return super().forward(tensordict)

    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Set the new estimate."""
        physics = cast(Quadrotor, self.model.model)
        body = physics.body
        state, action, after = (transitions.get(key) for key in self.loss.in_keys)
        thrust = within_motors(action, body)[..., 0]
        turns = (roma.unitquat_to_rotmat(part[..., 6:10])[..., 2] for part in (state, after))
        axis = sum(turns) / 2
        enough = thrust >= self.least_thrust * body.hover_thrust
        speeds = state[..., 3:6], after[..., 3:6]
        seen = inverse_mass(*speeds, axis, thrust.where(enough, 1.0), physics.dt, body.gravity)
        regime = self.model.parameters_now.clone()
        factor = regime[..., self.column]
        inverse = torch.lerp(1 / factor, seen * body.mass, self.share)
        fresh = 1 / inverse.clamp(1 / self.most, 1 / self.least)
        regime[..., self.column] = torch.where(learn & enough & seen.isfinite(), fresh, factor)
        self.model.set_regime(regime)
