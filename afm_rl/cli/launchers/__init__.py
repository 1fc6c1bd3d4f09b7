"""Where jobs run: on this machine, on a SLURM cluster, on a Ray cluster.

Whatever the launcher, a job is a process of its own, so that no job can harm another.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

from hydra.core.plugins import Plugins

from afm_rl.cli.launchers.local import LocalLauncher
from afm_rl.cli.launchers.ray_cluster import RayLauncher
from afm_rl.cli.launchers.slurm import SubmititLauncher

__all__ = ["LocalLauncher", "RayLauncher", "SubmititLauncher", "register"]

NAMESPACE = "hydra_plugins"


def register() -> None:
    """Make the launchers known to Hydra as ``hydra_plugins.afm_rl``, in this process only.

    Hydra takes launchers from that namespace alone; what is installed there is loaded by every
    Hydra application, so nothing of ours is.
    """
    try:
        namespace = importlib.import_module(NAMESPACE)
    except ModuleNotFoundError:
        namespace = sys.modules[NAMESPACE] = ModuleType(NAMESPACE)
        namespace.__path__ = []
    vars(namespace)["afm_rl"] = sys.modules[__name__]
    for launcher in (LocalLauncher, RayLauncher, SubmititLauncher):
        launcher.__module__ = f"{NAMESPACE}.afm_rl"
        Plugins.instance().register(launcher)
