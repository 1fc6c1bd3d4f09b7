"""Action Flow Matching for continual robot learning, on TorchRL.

Importing the package registers its gymnasium environments. The transform of TorchRL, the wrappers
for gymnasium and Stable-Baselines3, ``check_model`` and ``fit_residual`` are imported when they are
first used; everything else is imported from its own package, for example ``from afm_rl.planning
import MPPI``.
"""

import gymnasium
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if "afm_rl/UGVTrack-v0" not in gymnasium.registry:  # strings only: nothing heavy is imported
    gymnasium.register(
        id="afm_rl/UGVTrack-v0",
        entry_point="afm_rl.envs.ugv.gym:UGVTrackGym",
        max_episode_steps=5000,
    )
    gymnasium.register(
        id="afm_rl/CrazyflieTrack-v0", entry_point="afm_rl.envs.quadrotor.env:CrazyflieTrackGym"
    )
