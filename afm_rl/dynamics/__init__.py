"""Dynamics models: interchangeable ``(state, action) -> next state``."""

from afm_rl.dynamics.base import DynamicsModel, UnknownDynamics
from afm_rl.dynamics.calibrated import Calibrated
from afm_rl.dynamics.dubins import Dubins, dubins_step
from afm_rl.dynamics.ensemble import Ensemble
from afm_rl.dynamics.inverse import EffectiveAction, effective_action
from afm_rl.dynamics.knode import KNODE
from afm_rl.dynamics.known import KnownDynamics, ParametricDynamics, PhysicsModel
from afm_rl.dynamics.mujoco import MuJoCoDynamics
from afm_rl.dynamics.oracle import Oracle
from afm_rl.dynamics.quadrotor import Quadrotor

__all__ = [
    "KNODE",
    "Calibrated",
    "DynamicsModel",
    "Dubins",
    "EffectiveAction",
    "Ensemble",
    "KnownDynamics",
    "MuJoCoDynamics",
    "Oracle",
    "ParametricDynamics",
    "PhysicsModel",
    "Quadrotor",
    "UnknownDynamics",
    "dubins_step",
    "effective_action",
]
