"""What happens in one control tick of the quadrotor: pure functions of the tensordict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.dynamics.quadrotor import quadrotor_path
from afm_rl.envs.courses.flights import Reference, references_at
from afm_rl.envs.missions.simulation import PhasedSimulation
from afm_rl.regimes import Regime, Schedule, wind_of
from afm_rl.spaces.airframe import QuadrotorBody, within_motors
from afm_rl.spaces.manifold import RigidBodySpace


@dataclass(frozen=True)
class QuadrotorSimulation(PhasedSimulation):
    r"""Quadrotors under regimes, without any state or random numbers of its own.

    The plant takes ``substeps`` Runge-Kutta steps per tick, while the effective action

    .. math:: u_\mathrm{eff} = g(\mathrm{saturate}(u); \rho_t)

    is held. The regime acts on what the motors give. Arguments are those of
    :class:`~afm_rl.envs.CrazyflieTrack`, with ``sensor_noise`` as a tensor ``(12,)`` and the
    duration as a number of ``steps``.
    """

    references: Sequence[Reference]
    regime: Regime
    schedule: Schedule
    body: QuadrotorBody
    dt: float
    substeps: int
    steps: int
    horizon: int
    preview: bool
    start: str
    limit: float
    sensor_noise: Tensor
    trace: bool = False

    def begin(self, mission: TensorDictBase, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return the state at the beginning of flights: at the reference, level, not turning."""
        none = torch.zeros_like(mission["seed"])
        wanted = self._wanted(mission, none.to(dtype).unsqueeze(-1)).squeeze(-2)
        turning = torch.zeros(*none.shape, 7, dtype=dtype, device=none.device)
        turning[..., 3] = 1.0
        if self.start == "rest":
            wanted = torch.cat([wanted[..., :3], torch.zeros_like(wanted[..., 3:])], -1)
        return self.started(torch.cat([wanted, turning], -1), mission, 4, lost=none.bool())

    def displaced(self, pose: Tensor, noise: Tensor) -> Tensor:
        return torch.cat([pose[..., :3] + noise, pose[..., 3:]], -1)

    def progress(self, mission: TensorDictBase, state: Any) -> Tensor:
        return state["step"].to(mission["at"].dtype) / self.steps

    def advance(
        self,
        data: TensorDictBase,
        sensor: Tensor | None,
        between: Tensor | None,
        actuator: Tensor | None,
    ) -> TensorDict:
        """Return what one control tick leads to.

        The numbers, standard normal, are for the observation ``(*B, 12)``, for the trace between
        two observations ``(*B, 12 (substeps - 1))``, and for a noisy regime ``(*B, 4)``.
        """
        mission, pose, step = data["mission"], data["pose"], data["step"]
        action = within_motors(data["action"].to(pose.dtype), self.body)
        path, plant = self.flown(data, action, self.regime_now(mission, data), actuator)

        # The published metric compares with the reference one plant step ahead of the state.
        ahead = torch.arange(2, self.substeps + 2, device=pose.device) * (self.dt / self.substeps)
        wanted = self._wanted(mission, step.unsqueeze(-1) * self.dt + ahead.to(pose))[..., :3]
        miss = wanted - path[..., :3].movedim(0, -2)
        flies = path.isfinite().all(-1).all(0) & (miss.norm(dim=-1) <= self.limit).all(-1)
        lost = data["lost"] | ~flies
        frozen = lost.unsqueeze(-1)
        miss = torch.where(frozen.unsqueeze(-1), wanted - pose[..., None, :3], miss)

        moved = {"pose": path[-1], **plant}
        state = {name: torch.where(frozen, data[name], value) for name, value in moved.items()}
        state.update(step=step + 1, lost=lost)
        state = self.followed(mission, data, state, action)
        out = self.describe(mission, state, sensor)
        if self.trace:
            passed = torch.where(frozen.unsqueeze(-1), pose.unsqueeze(-2), path.movedim(0, -2))
            passed = self._sense(passed[..., :-1, :], between)
            ends = (data.get("observation", pose).unsqueeze(-2), out["observation"].unsqueeze(-2))
            out["trace"] = torch.cat([ends[0], passed, ends[1]], -2)
        out["square_error"] = miss.square().mean(-2)
        out["reward"] = -out["square_error"].sum(-1, keepdim=True)
        return self.ended(out, lost)

    def flown(
        self, data: TensorDictBase, action: Tensor, parameters: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the state after each plant step, and what the plant remembers beside it.

        Given are the state before, the wrench ``(*B, 4)`` that the motors are asked for, the
        regime's parameters ``(*B, F)``, and numbers for a noisy one.
        """
        effective = self.effect(data, action, parameters, noise)
        flight = self.dt, self.substeps, self.body, wind_of(self.regime, parameters)
        return quadrotor_path(data["pose"], effective, *flight), {}

    def describe(
        self, mission: TensorDictBase, state: dict[str, Tensor], sensor: Tensor | None = None
    ) -> TensorDict:
        pose, step = state["pose"], state["step"]
        ticks = torch.arange(self.horizon + 1, device=pose.device) * self.preview
        times = ((step.unsqueeze(-1) + ticks) * self.dt).to(pose.dtype)
        times = times + self.dt / self.substeps  # as far ahead as the metric's
        seen = {
            "observation": self._sense(pose, sensor),
            "reference": self._wanted(mission, times),
            "square_error": torch.zeros_like(pose[..., :3]),
            "phase": self.phase(mission, state),
        }
        if self.trace:  # nothing has happened yet
            rows = seen["observation"].unsqueeze(-2)
            seen["trace"] = rows.repeat_interleave(self.substeps + 1, -2)
        return self.described(mission, state, **seen)

    def _sense(self, pose: Tensor, numbers: Tensor | None) -> Tensor:
        """Return states ``(*B, 13)`` as the sensors see them."""
        if numbers is None:
            return pose.clone()
        numbers = numbers.reshape(*pose.shape[:-1], 12)
        return RigidBodySpace().add(pose, numbers * self.sensor_noise.to(pose))

    def _wanted(self, mission: TensorDictBase, time: Tensor) -> Tensor:
        return references_at(self.references, mission["track"], time)
