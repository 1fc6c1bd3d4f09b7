"""Put Action Flow Matching into an environment that is not ours.

    python examples/transform/your_env.py

A cart on a hill from gymnasium (MountainCarContinuous) whose motor is reversed half-way. Its
nominal dynamics are three lines; one more line corrects the actions.
"""

import torch
from torchrl.envs import GymEnv, TransformedEnv

from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform


def hill(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Position (m) and velocity (m/step) of the cart after one step of gymnasium's own task."""
    position, velocity = state.unbind(-1)
    velocity = velocity + 0.0015 * action[..., 0] - 0.0025 * torch.cos(3 * position)
    return torch.stack([position + velocity, velocity], -1)


torch.set_num_threads(1)
model = KnownDynamics(hill, Manifold(2), action_size=1, noise_std=1e-5)
env = TransformedEnv(GymEnv("MountainCarContinuous-v0"), ActionFlowTransform(model))
td = env.reset(seed=0)
for step in range(40):
    td["action"] = torch.tensor([0.5]) if step % 4 < 2 else torch.tensor([-0.5])
    if step >= 20:  # the transform does not know that the motor is reversed now
        env.base_env._env.unwrapped.power = -0.0015
    before = hill(td["observation"], torch.zeros(1))[1]  # its velocity without the motor
    td = env.step(td)
    if step in (10, 19, 21, 30, 39):
        change = float(td["next", "observation"][1] - before)
        print(
            f"step {step:2d}  planned {float(td['action']):+.2f}  "
            f"executed {float(td['next', 'afm', 'executed_action']):+.2f}  "
            f"misaligned {bool(td['next', 'afm', 'misaligned'])!s:5}  "
            f"effect of the motor {change / 0.0015:+.2f}"
        )
    td = td["next"].exclude("reward")
