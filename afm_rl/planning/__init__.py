"""Planners, and the world in which they imagine."""

from afm_rl.planning.costs import Cost, GoalDistance, KnownReward, QuadraticCost, TrackingCost
from afm_rl.planning.handover import Handover
from afm_rl.planning.icem import ICEM
from afm_rl.planning.imported_policy import policy_from_cleanrl, policy_from_sb3
from afm_rl.planning.mpc import MPC
from afm_rl.planning.mppi import MPPI
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.planning.policies import (
    LawPlanner,
    PolicyPlanner,
    StoredPolicy,
    load_policy,
    save_policy,
)
from afm_rl.planning.shooting import CEM, TorchRLMPPI

__all__ = [
    "CEM",
    "ICEM",
    "MPC",
    "MPPI",
    "Cost",
    "GoalDistance",
    "Handover",
    "KnownReward",
    "LawPlanner",
    "PlanningEnv",
    "PolicyPlanner",
    "QuadraticCost",
    "StoredPolicy",
    "TorchRLMPPI",
    "TrackingCost",
    "load_policy",
    "policy_from_cleanrl",
    "policy_from_sb3",
    "save_policy",
]
