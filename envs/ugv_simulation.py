"""What happens in one step of the ground robot: pure functions of the tensordict."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.dynamics import dubins_step
from afm_rl.envs.course import Course
from afm_rl.manifold import wrap_angle
from afm_rl.regimes import Regime, Schedule, blend_phases


class UGVSimulation(nn.Module):
    r"""Dubins robots under regimes, without any state or random numbers of its own.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t)) + \epsilon_t

    The regime acts after the clamp, and its result is not clamped again. It may depend on the
    clamped actions before, and on noise. Arguments are those of
    :class:`~afm_rl.envs.UGVTrack`, with the bounds ``low`` and ``high`` as tensors ``(2,)``.
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
        dt: float,
        reach: float,
        max_steps: int,
    ) -> None:
        super().__init__()
        self.course = course
        self.regime = regime
        self.schedule = schedule
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.dt = dt
        self.reach = reach
        self.max_steps = max_steps

    def start(self, mission: TensorDictBase, noise: Tensor) -> Tensor:
        """Return start poses ``(*B, 3)``, displaced by ``noise`` ``(*B, 3)``."""
        return _wrapped(self.course.starts[mission["track"]] + noise)

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
        parameters = self.regime_now(mission, before, data["step"], data["since"])
        effective = self.regime.apply(action, parameters, pose, past, actuator)
        moved = _wrapped(dubins_step(pose, effective, self.dt) + noise)

        track = mission["track"]
        goal = self.course.goal(track, before)
        gap = (moved[..., :2] - goal).norm(dim=-1)
        hit = (gap < self.reach) & ~self.course.finished(track, before)
        reached, step = before + hit, data["step"] + 1
        gained = (pose[..., :2] - goal).norm(dim=-1) - gap
        terminated = self.course.finished(track, reached)
        truncated = step >= self.max_steps
        same = self._phase(mission, before, data["step"]) == self._phase(mission, reached, step)
        since = torch.where(same, data["since"], step)
        if past is not None:
            past = torch.cat([action.unsqueeze(-2), past[..., :-1, :]], -2)
        out = self.describe(mission, moved, reached, step, since, past)
        out["reward"] = (gained + hit).unsqueeze(-1)
        out["terminated"] = terminated.unsqueeze(-1)
        out["truncated"] = truncated.unsqueeze(-1)
        out["done"] = (terminated | truncated).unsqueeze(-1)
        return out

    def describe(
        self,
        mission: TensorDictBase,
        pose: Tensor,
        reached: Tensor,
        step: Tensor,
        since: Tensor,
        past: Tensor | None = None,
    ) -> TensorDict:
        """Return the state and what is seen of it."""
        parameters = self.regime_now(mission, reached, step, since)
        entries = {
            "pose": pose,
            "reached": reached,
            "step": step,
            "since": since,
            "mission": mission.clone(),
            "observation": pose.clone(),
            "goal": self.course.goal(mission["track"], reached),
            "regime": parameters,
            "regime_active": ~self.regime.is_identity(parameters),
        }
        if past is not None:
            entries["past"] = past
        return TensorDict(entries, mission.batch_size, device=mission.device)

    def regime_now(
        self, mission: TensorDictBase, reached: Tensor, step: Tensor, since: Tensor
    ) -> Tensor:
        """Return the parameters ``(*B, F)`` that act on the next action.

        Args:
            mission: parameters, breakpoints and ramp.
            reached: number of targets reached, ``(*B)``.
            step: number of steps taken, ``(*B)``.
            since: step at which the present phase began, ``(*B)``.
        """
        phase = self._phase(mission, reached, step)
        return blend_phases(mission["parameters"], phase, step - since, mission["ramp"])

    def _phase(self, mission: TensorDictBase, reached: Tensor, step: Tensor) -> Tensor:
        progress = self.course.progress(mission["track"], reached)
        return self.schedule.phase(progress, step, mission["at"])


def _wrapped(pose: Tensor) -> Tensor:
    return torch.cat([pose[..., :2], wrap_angle(pose[..., 2:])], -1)
