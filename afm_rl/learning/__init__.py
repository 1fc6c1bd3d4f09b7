"""Learning: losses, updaters, optimisers, pre-training."""

from afm_rl.learning.collect import collect
from afm_rl.learning.fitting import FitReport, fit_ensemble, pretrain_ensemble
from afm_rl.learning.knode_fit import pretrain_knode
from afm_rl.learning.knode_updater import KNODEUpdater
from afm_rl.learning.loss import GaussianNLLLoss, InPlaceLoss, gaussian_nll
from afm_rl.learning.online_updater import OnlineUpdater, StreamXUpdater, UnmatchedUpdater
from afm_rl.learning.optimisers import ObGD, ResetAdam
from afm_rl.learning.physics_identifier import PhysicsIdentifier
from afm_rl.learning.rls_updater import RLSUpdater
from afm_rl.learning.updater import Learner, OracleUpdater, Updater, UpdaterHook

__all__ = [
    "FitReport",
    "ResetAdam",
    "GaussianNLLLoss",
    "InPlaceLoss",
    "KNODEUpdater",
    "Learner",
    "ObGD",
    "OnlineUpdater",
    "OracleUpdater",
    "PhysicsIdentifier",
    "RLSUpdater",
    "StreamXUpdater",
    "UnmatchedUpdater",
    "Updater",
    "UpdaterHook",
    "collect",
    "fit_ensemble",
    "gaussian_nll",
    "pretrain_ensemble",
    "pretrain_knode",
]
