from .costs import (
    Cost as Cost,
    GoalDistance as GoalDistance,
    KnownReward as KnownReward,
    TrackingCost as TrackingCost,
)
from .icem import ICEM as ICEM
from .imported_policy import (
    policy_from_cleanrl as policy_from_cleanrl,
    policy_from_sb3 as policy_from_sb3,
)
from .mpc import MPC as MPC
from .mppi import MPPI as MPPI
from .onnx_policy import policy_from_onnx as policy_from_onnx
from .planning_env import PlanningEnv as PlanningEnv
from .policies import (
    PolicyPlanner as PolicyPlanner,
    StoredPolicy as StoredPolicy,
    load_policy as load_policy,
    save_policy as save_policy,
)
from .shooting import CEM as CEM
