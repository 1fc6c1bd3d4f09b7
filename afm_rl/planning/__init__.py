"""Planners, and the world in which they imagine."""

from afm_rl.planning.costs import Cost, GoalDistance
from afm_rl.planning.mpc import MPC
from afm_rl.planning.mppi import MPPI
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.planning.shooting import CEM, TorchRLMPPI
from afm_rl.planning.tracking import QuadraticCost, TrackingCost

__all__ = [
    "CEM",
    "MPC",
    "MPPI",
    "Cost",
    "GoalDistance",
    "PlanningEnv",
    "QuadraticCost",
    "TorchRLMPPI",
    "TrackingCost",
]
