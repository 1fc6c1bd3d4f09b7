"""The pendulum of the examples in this folder: its motor is reversed, and AFM corrects its actions.

    python examples/torchrl/swing_up.py

It prints the accuracy of the model on the healthy pendulum, and how often the motor follows the
plan.
"""

import torch
from torchrl.envs import Compose, GymEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from afm_rl import check_model
from afm_rl.dynamics import KnownDynamics
from afm_rl.regimes import ActionGain
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform, RegimeTransform


def swing(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """One step (0.05 s) of Pendulum-v1; the state is (cos, sin, speed)."""
    cos, sin, speed = state.unbind(-1)
    speed = (speed + 0.05 * (15.0 * sin + 3.0 * action[..., 0])).clamp(-8.0, 8.0)
    angle = torch.atan2(sin, cos) + 0.05 * speed
    return torch.stack([angle.cos(), angle.sin(), speed], -1)


def correction(gain: float, corrected: bool = True) -> Transform:
    """Return a motor with a gain, and a correction that does not know the gain."""
    motor = RegimeTransform(ActionGain(["torque"]), [{"torque": gain}])
    model = KnownDynamics(swing, Manifold(3), action_size=1)
    return Compose(motor, ActionFlowTransform(model, enabled=corrected))


def make_env(gain: float = -1.0, corrected: bool = True) -> TransformedEnv:
    """Return the pendulum; its motor is reversed if ``gain`` is -1."""
    return TransformedEnv(GymEnv("Pendulum-v1"), correction(gain, corrected))


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.manual_seed(0)
    check_env_specs(make_env())
    print(check_model(GymEnv("Pendulum-v1"), swing))
    for corrected in (False, True):
        env = make_env(corrected=corrected)
        env.set_seed(0)
        data = env.rollout(100)
        miss = (data["next", "regime", "effective_action"] - data["action"]).abs()
        same = (miss < 0.1 * env.action_spec.space.high).float().mean()
        how = "with AFM" if corrected else "without AFM"
        print(f"reversed, {how}: the motor does what was planned in {same:.0%} of the steps")
