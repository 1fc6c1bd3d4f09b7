"""A model conditioned on the true regime: an upper bound, not a method."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel, closed_form
from afm_rl.dynamics.mujoco import MuJoCoDynamics
from afm_rl.dynamics.rates import linearised
from afm_rl.regimes import Regime


class Oracle(DynamicsModel):
    """Nominal dynamics seen through the true regime. For comparison only.

    It knows every parameter, but neither the noise nor earlier actions, so it does not plan for a
    delay.

    Args:
        model: the nominal dynamics.
        regime: the regime family of the environment.

    :meth:`set_regime` sets the parameters ``(F,)`` or, per mission, ``(*L, F)``.

    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.regimes import ActionGain
    >>> gains = ActionGain(["v_gain", "omega_gain"])
    >>> oracle = Oracle(Dubins(), gains)
    >>> oracle.set_regime(gains.encode({"v_gain": -1.0}))
    >>> oracle(torch.zeros(3), torch.tensor([1.0, 0.0]))
    tensor([-0.2000,  0.0000,  0.0000])
    """

    conditioned_on = "regime"
    parameters_now: Tensor

    def __init__(self, model: DynamicsModel, regime: Regime) -> None:
        super().__init__(model.manifold, model.action_size)
        self.model = model
        self.extrapolates = model.extrapolates
        self.regime = regime
        self.register_buffer("parameters_now", torch.tensor(regime.identity), persistent=False)

    @property
    def lead(self) -> torch.Size:
        """Leading dimensions of the parameters last set."""
        return self.parameters_now.shape[:-1]

    def set_regime(self, parameters: Tensor) -> None:
        """Set the current parameters of the regime."""
        self.parameters_now = parameters.detach()
        physics = self.regime.physics_of(self.parameters_now)
        if physics is not None and isinstance(self.model, MuJoCoDynamics):
            self.model.set_physics(physics)

    def effective(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the effective action under the present regime."""
        return self.regime.apply(action, self._regime_for(action), state)

    def command(self, state: Tensor, effect: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Return the actions within bounds ``(A,)`` with the effect nearest to ``(*B, A)``.

        See :meth:`~afm_rl.regimes.Regime.inverse`; a delay or a lag cannot be undone.
        """
        return self.regime.inverse(effect, self._regime_for(effect), state, low, high)

    def _regime_for(self, action: Tensor) -> Tensor:
        """Return the parameters of the present regime, for actions ``(*L, ..., A)``."""
        now = self.parameters_now
        extra = action.dim() - now.dim()
        return now.reshape(*now.shape[:-1], *(1,) * extra, now.shape[-1])

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.model(state, self.effective(state, action))

    @closed_form
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states ``(*B, N, H, S)`` of plans; at once if effects are known."""
        if self.regime.by_state:
            return super().rollout(state, actions)
        return self.model.rollout(state, self.effective(state[..., None, None, :], actions))

    @closed_form
    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        effective, in_state, in_action = linearised(self.effective, state, action)
        ahead, by_state, by_effective = self.model.linearise(state, effective)
        return ahead, by_state + by_effective @ in_state, by_effective @ in_action

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return self.model.moments(state, self.effective(state, action))

    def standardise(self, change: Tensor) -> Tensor:
        return self.model.standardise(change)

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self.model.noise_scale(state, self.effective(state, action))

    def select_(self, index: Tensor) -> Oracle:
        if self.lead:
            self.set_regime(self.parameters_now[index])
        return self
