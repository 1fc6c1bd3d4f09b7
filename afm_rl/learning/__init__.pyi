from .collect import collect as collect
from .fitting import (
    FitReport as FitReport,
    fit_ensemble as fit_ensemble,
    pretrain_ensemble as pretrain_ensemble,
)
from .knode_fit import pretrain_knode as pretrain_knode
from .knode_updater import KNODEUpdater as KNODEUpdater
from .loss import (
    GaussianNLLLoss as GaussianNLLLoss,
    gaussian_nll as gaussian_nll,
)
from .online_updater import (
    OnlineUpdater as OnlineUpdater,
    StreamXUpdater as StreamXUpdater,
    UnmatchedUpdater as UnmatchedUpdater,
)
from .optimisers import ObGD as ObGD, ResetAdam as ResetAdam
from .rls_updater import RLSUpdater as RLSUpdater
from .updater import Learner as Learner, OracleUpdater as OracleUpdater, Updater as Updater
from .updater_hook import UpdaterHook as UpdaterHook
