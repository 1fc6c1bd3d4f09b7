from .base import DynamicsModel as DynamicsModel, UnknownDynamics as UnknownDynamics
from .calibrated import Calibrated as Calibrated
from .dubins import Dubins as Dubins, dubins_step as dubins_step
from .ensemble import Ensemble as Ensemble
from .inverse import EffectiveAction as EffectiveAction, effective_action as effective_action
from .knode import KNODE as KNODE
from .known import (
    KnownDynamics as KnownDynamics,
    ParametricDynamics as ParametricDynamics,
    PhysicsModel as PhysicsModel,
)
from .linear_residual import LinearResidual as LinearResidual
from .mujoco import MuJoCoDynamics as MuJoCoDynamics
from .oracle import Oracle as Oracle
from .quadrotor import Quadrotor as Quadrotor
