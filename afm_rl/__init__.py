"""Action Flow Matching for continual robot learning, on TorchRL.

Importing the package registers its gymnasium environments, and gives the wrappers for gymnasium and
Stable-Baselines3 and ``check_model`` when they are asked for; everything else is imported from its
own module, for example ``from afm_rl.transforms import ActionFlowTransform``.
"""

from importlib import import_module
from typing import Any

import gymnasium

from afm_rl._version import __version__

MODULES = {
    "ActionFlowVecEnv": "stable_baselines",
    "ActionFlowVectorWrapper": "gymnasium",
    "ActionFlowWrapper": "gymnasium",
    "FaultVectorWrapper": "fault_wrapper",
    "FaultWrapper": "fault_wrapper",
    "check_model": "check_model",
}
__all__ = ["__version__", *MODULES]

if "afm_rl/UGVTrack-v0" not in gymnasium.registry:  # strings only: nothing heavy is imported
    gymnasium.register(
        id="afm_rl/UGVTrack-v0",
        entry_point="afm_rl.envs.ugv.gym:UGVTrackGym",
        max_episode_steps=5000,
    )
    gymnasium.register(
        id="afm_rl/CrazyflieTrack-v0", entry_point="afm_rl.envs.quadrotor.env:CrazyflieTrackGym"
    )


def __getattr__(name: str) -> Any:
    """Import what is heavy when it is asked for."""
    if name not in MODULES:
        raise AttributeError(f"module 'afm_rl' has no attribute {name!r}")
    return getattr(import_module(f"afm_rl.transforms.{MODULES[name]}"), name)
