"""Learning: losses, updaters, optimisers, pre-training."""

from afm_rl.learning.collect import collect
from afm_rl.learning.fitting import FitReport, fit_ensemble
from afm_rl.learning.hook import UpdaterHook
from afm_rl.learning.knode_updater import KNODEUpdater
from afm_rl.learning.learner import Learner
from afm_rl.learning.loss import InPlaceLoss
from afm_rl.learning.nll import GaussianNLLLoss, gaussian_nll
from afm_rl.learning.obgd import ObGD
from afm_rl.learning.online_updater import OnlineUpdater
from afm_rl.learning.physics_identifier import PhysicsIdentifier
from afm_rl.learning.pretrain import pretrain_ensemble
from afm_rl.learning.pretrain_knode import pretrain_knode
from afm_rl.learning.reset_adam import ResetAdam
from afm_rl.learning.rls_updater import RLSUpdater
from afm_rl.learning.stream_x import StreamXUpdater
from afm_rl.learning.unmatched_updater import UnmatchedUpdater
from afm_rl.learning.updater import OracleUpdater, Updater

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
