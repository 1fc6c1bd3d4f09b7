"""What happens in one step of the ground robot: pure functions of the tensordict."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.dynamics import DynamicsModel, MuJoCoDynamics
from afm_rl.envs.courses.course import Course
from afm_rl.envs.missions.phases import PhasedSimulation
from afm_rl.regimes import Regime, Schedule
from afm_rl.spaces.manifold import wrap_angle


class UGVSimulation(nn.Module, PhasedSimulation):
    r"""Ground robots under regimes, without any state or random numbers of its own.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t)) + \epsilon_t

    The regime acts after the clamp, and its result is not clamped again. It may depend on the
    clamped actions before, and on noise. A state begins with the pose x, y, theta, the only part
    with noise; the others begin at zero. Arguments are those of :class:`~afm_rl.envs.UGVTrack`,
    with the bounds ``low`` and ``high`` as tensors ``(2,)``.
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        course: Course,
        regime: Regime,
        schedule: Schedule,
        low: Tensor,
        high: Tensor,
        world: DynamicsModel,
        observed: int,
        reach: float,
        steps: int,
    ) -> None:
        super().__init__()
        self.course = course
        self.regime = regime
        self.schedule = schedule
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.world = world
        self.observed = observed
        self.reach = reach
        self.steps = steps

    def begin(self, mission: TensorDictBase, dtype: torch.dtype) -> dict[str, Tensor]:
        pose = self._whole(_wrapped(self.course.starts[mission["track"]].to(dtype)))
        return self.started(pose, mission, 2, reached=torch.zeros_like(mission["track"]))

    def displaced(self, pose: Tensor, noise: Tensor) -> Tensor:
        return _wrapped(pose + self._whole(noise))

    def progress(self, mission: TensorDictBase, state: Any) -> Tensor:
        return self.course.progress(mission["track"], state["reached"])

    def advance(
        self, data: TensorDictBase, noise: Tensor, actuator: Tensor | None = None
    ) -> TensorDict:
        """Return what one step leads to.

        Args:
            data: ``mission``, ``pose``, ``reached``, ``step``, ``since``, ``action`` and, for a
                regime with a history, ``past``.
            noise: what is added to the poses (m, m, rad), ``(*B, 3)``.
            actuator: standard normal numbers for a noisy regime, ``(*B, 2)``.
        """
        mission, pose, before = data["mission"], data["pose"], data["reached"]
        action = data["action"].to(pose.dtype).clamp(self.low, self.high)
        past = data["past"] if self.regime.history else None
        parameters = self.regime_now(mission, data)
        effective = self.regime.apply(action, parameters, pose, past, actuator)
        moved = _wrapped(self._ahead(pose, effective, parameters) + self._whole(noise))

        track = mission["track"]
        goal = self.course.goal(track, before)
        gap = (moved[..., :2] - goal).norm(dim=-1)
        hit = (gap < self.reach) & ~self.course.finished(track, before)
        gained = (pose[..., :2] - goal).norm(dim=-1) - gap
        state = {"pose": moved, "reached": before + hit, "step": data["step"] + 1}
        out = self.describe(mission, self.followed(mission, data, state, action))
        out["reward"] = (gained + hit).unsqueeze(-1)
        out["terminated"] = self.course.finished(track, state["reached"]).unsqueeze(-1)
        out["truncated"] = (state["step"] >= self.steps).unsqueeze(-1)
        out["done"] = out["terminated"] | out["truncated"]
        return out

    def describe(self, mission: TensorDictBase, state: dict[str, Tensor]) -> TensorDict:
        goal = self.course.goal(mission["track"], state["reached"])
        seen = state["pose"][..., : self.observed].clone()
        return self.described(mission, state, observation=seen, goal=goal)

    def _ahead(self, pose: Tensor, effective: Tensor, parameters: Tensor) -> Tensor:
        """Return the next states; nothing of the missions' physics stays in the world."""
        physics = self.regime.physics_of(parameters)
        if physics is None or not isinstance(self.world, MuJoCoDynamics):
            return self.world(pose, effective)
        self.world.set_physics(physics)
        ahead = self.world(pose, effective)
        self.world.set_physics(None)
        return ahead

    def _whole(self, pose: Tensor) -> Tensor:
        """Put zeros after the pose ``(*B, 3)``."""
        return nn.functional.pad(pose, (0, self.world.state_size - pose.shape[-1]))


def _wrapped(pose: Tensor) -> Tensor:
    return torch.cat([pose[..., :2], wrap_angle(pose[..., 2:3]), pose[..., 3:]], -1)
