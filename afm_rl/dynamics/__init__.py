"""Dynamics models: interchangeable ``(state, action) -> next state``."""

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.dynamics.dubins import Dubins, dubins_step
from afm_rl.dynamics.ensemble import Ensemble
from afm_rl.dynamics.known import KnownDynamics
from afm_rl.dynamics.oracle import Oracle

__all__ = ["DynamicsModel", "Dubins", "Ensemble", "KnownDynamics", "Oracle", "dubins_step"]
