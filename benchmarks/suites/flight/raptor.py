"""RAPTOR, a published policy for any quadrotor, as a planner."""

from __future__ import annotations

from collections.abc import Sequence

import roma
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics.quadrotor import check_body
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.planning.receding import RecedingHorizonPlanner
from afm_rl.spaces.airframe import QuadrotorBody, mix

HIDDEN = 16  # numbers of its recurrent layer
MOTORS = (-45.0, -135.0, 135.0, 45.0)  # directions of its motors, degrees


class Raptor(RecedingHorizonPlanner):
    """RAPTOR (Eschmann et al. 2026): 2084 weights that adapt to a quadrotor while they fly it.

    It has no model. It observes the errors of position and velocity, the attitude, the body rate
    and its last action, and sets the speeds of four motors between none and the highest; the
    action is the wrench of these speeds on a healthy body. It was trained with ticks of 10 ms.

    Args:
        env: the planning environment: the keys of state and action, and the action bounds.
        body: the quadrotor, in cross configuration.
        horizon: length N of the preview, ticks; RAPTOR reads only the current set-point.
        reference_key: desired position and velocity, the current ones first, ``(*B, N + 1, 6)``.
        prefix: key of its memory.

    Raises:
        ConfigurationError: for another body, or if the package foundation-policy is missing.
    """

    def __init__(
        self,
        env: PlanningEnv,
        body: QuadrotorBody | None = None,
        horizon: int = 1,
        reference_key: NestedKey = "reference",
        prefix: NestedKey = "raptor",
    ) -> None:
        super().__init__(env, {(prefix, "hidden"): (HIDDEN,), (prefix, "last"): (4,)})
        try:
            from foundation_policy import Raptor as published
        except ImportError as error:
            raise ConfigurationError(
                "planner=raptor: foundation-policy is missing; pip install foundation-policy"
            ) from error
        self.body, self.reference_key = check_body(body), reference_key
        if sorted(self.body.motors) != sorted(MOTORS):
            raise ConfigurationError(
                f"planner.body: motors at {list(self.body.motors)} degrees: expected "
                f"{list(MOTORS)}, in any order; choose robot=quadrotor_rotorpy"
            )
        self.stages = check_count("planner.horizon", horizon) + 1
        self.order = [MOTORS.index(angle) for angle in self.body.motors]
        self.observation_key = env.observation_key
        self.in_keys = [self.observation_key, self.reference_key, *self.memory]
        self.policy = published()
        self.policy.reset()

    def plan(self, td: TensorDictBase) -> tuple[Tensor, Sequence[Tensor]]:
        state, wanted = td.get(self.observation_key), td.get(self.reference_key)
        hidden, last = self._recall(td)
        miss = state[..., :6] - wanted.reshape(*td.batch_size, -1, 6)[..., 0, :]
        seen = roma.unitquat_to_rotmat(state[..., 6:10])
        parts = [miss[..., :3], seen.flatten(-2), miss[..., 3:], state[..., 10:], last]
        numbers = torch.cat(parts, -1).reshape(-1, 22).cpu().numpy()
        recurrent = self.policy.layers[1]
        recurrent.state = hidden.reshape(-1, HIDDEN).cpu().numpy()
        speeds_asked = torch.from_numpy(self.policy.evaluate_step(numbers)).to(last)
        speeds_asked = speeds_asked.clamp(-1.0, 1.0).reshape(last.shape)
        hidden = torch.from_numpy(recurrent.state).to(hidden).reshape(hidden.shape)
        self.policy.reset()  # its memory is only in the tensordict
        speeds = self.body.rotor_speed * (speeds_asked[..., self.order] + 1) / 2
        return mix(self.body.k_t * speeds.square(), self.body), [hidden, speeds_asked]
