"""Action Flow Matching for continual robot learning, on TorchRL.

Importing the package registers its gymnasium environments; everything else is imported from
its own module, for example ``from afm_rl.transforms import ActionFlowTransform``.
"""

import gymnasium

from afm_rl._version import __version__

__all__ = ["__version__"]

if "afm_rl/UGVTrack-v0" not in gymnasium.registry:  # strings only: nothing heavy is imported
    gymnasium.register(
        id="afm_rl/UGVTrack-v0",
        entry_point="afm_rl.envs.ugv_gym:UGVTrackGym",
        vector_entry_point="afm_rl.envs.ugv_vector:UGVTrackVectorEnv",
        max_episode_steps=5000,
    )
    gymnasium.register(
        id="afm_rl/CrazyflieTrack-v0", entry_point="afm_rl.envs.quadrotor_gym:CrazyflieTrackGym"
    )
