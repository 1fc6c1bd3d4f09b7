"""Missions in somebody else's task, whose dynamics change under way."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.envs.missions.env import MissionEnv
from afm_rl.envs.missions.format import MissionNoise
from afm_rl.envs.missions.settings import check_bounds, check_regime
from afm_rl.envs.missions.simulation import BoundedSimulation
from afm_rl.envs.task.task import Task
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.imports import check_installed
from afm_rl.options import Count, options
from afm_rl.regimes import ActionGain, Regime, Schedule

if TYPE_CHECKING:
    import pandas as pd


class TaskEnv(MissionEnv):
    r"""Episodes of a :class:`~afm_rl.envs.Task` under regimes, batched.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t))

    with the task's world f and a regime g that is hidden from the robot. The observation is the
    whole state, the reward is the task's, and a mission's progress is the share of its episode
    that has passed. The seed of a mission determines its initial state; after an automatic reset
    the next episode starts from another state.

    Args:
        task: the task with its world.
        tracks: only the task's name is allowed.
        regime: changes of actions; gains if None.
        schedule: times of the changes; half-way if None.
        max_steps: length of an episode, at most the task's; the task's if None.
        action_low: lower bounds of the actions; the task's if None.
        action_high: upper bounds. Actions are clamped before the regime acts on them.
        settings: further arguments of :class:`~afm_rl.envs.missions.env.MissionEnv`:
            ``batch_size``, ``seed``, ``device``, ``missions`` and ``dtype``.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.
    """

    simulation: TaskSimulation

    @options("")
    def __init__(
        self,
        task: Task,
        tracks: Sequence[str] | None = None,
        regime: Regime | None = None,
        schedule: Schedule | None = None,
        max_steps: Annotated[Count | None, "steps of an episode; None: those of the task"] = None,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(0.0, **settings)
        if tracks is not None and list(tracks) != [task.name]:
            raise ConfigurationError(f"tracks={list(tracks)}: expected all, or {task.name}")
        low, high = (
            list(own) if given is None else given
            for own, given in ((task.low, action_low), (task.high, action_high))
        )
        bounds = check_bounds(low, high, task.action_names, self.dtype)
        axes = range(len(low))
        default = ActionGain([f"gain_{axis}" for axis in axes])
        steps = task.steps if max_steps is None else max_steps
        schedule = Schedule([0.5]) if schedule is None else schedule
        self.task = task
        self.noise = MissionNoise({"actuator": (0x5441534B, len(low))})
        self.simulation = TaskSimulation(
            task,
            regime=check_regime(regime, lambda: default, len(task.state_names), len(low)),
            schedule=check_instance("schedule", schedule, Schedule),
            bounds=bounds,
            steps=min(steps, task.steps),
        ).to(self.device)
        self._complete([task.name], bounds)

    def draw(self, steps: pd.DataFrame) -> Iterator[np.ndarray]:
        """Yield a picture ``(H, W, 3)`` of each row of a table of steps.

        Robots of MuJoCo are drawn as bodies, others as curves of the state.
        """
        check_installed("films", "matplotlib")
        from afm_rl.film import body_pictures, curves

        states = steps[list(self.task.state_names)].to_numpy()
        if isinstance(self.task.world, MuJoCoDynamics):
            return body_pictures(self.task.world.mjcf, states)
        return curves(steps["t"].to_numpy(), states, self.task.state_names)

    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        noise = self._actuator_noise(tensordict["mission", "seed"])
        return self.simulation.advance(tensordict, noise)

    def _begun(self, mission: TensorDictBase, rows: Tensor | None) -> dict[str, Tensor]:
        return self.simulation.begin(mission, self.dtype, rows)

    def _missions_of(self, given: TensorDictBase | None, batch: torch.Size) -> TensorDict:
        mission = super()._missions_of(given, batch)
        again = None if given is None else given.get("_reset", None)
        if again is not None:
            # An episode that follows of itself begins elsewhere.
            mission["seed"] = mission["seed"] + 1_000_003 * again.reshape(batch)
        return mission


class TaskSimulation(BoundedSimulation):
    """One step of a task under a regime: pure functions of the tensordict.

    Args:
        task: the task.
        settings: those of :class:`~afm_rl.envs.missions.simulation.BoundedSimulation`.
    """

    def __init__(self, task: Task, **settings: Any) -> None:
        super().__init__(**settings)
        self.task = task

    def begin(
        self, mission: TensorDictBase, dtype: torch.dtype, rows: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the state at the beginning of missions; only ``rows`` are asked for."""
        physics = self.regime.physics_of(mission["parameters"][..., 0, :])
        first = {
            name: value.to(self.low.device, dtype if value.is_floating_point() else value.dtype)
            for name, value in self.task.begin(mission["seed"], rows, physics).items()
        }
        return self.started(first.pop("pose"), mission, len(self.low), **first)

    def get_extra_state(self) -> dict[str, Any]:
        """Return what environments that keep their state to themselves have lived through."""
        return self.task.history()

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self.task.replay(state)

    def displaced(self, pose: Tensor, noise: Tensor) -> Tensor:
        """Return poses as they are: the task draws where missions begin."""
        return pose

    def progress(self, mission: TensorDictBase, state: Any) -> Tensor:
        """Return the share of the episode that has passed in the middle of the next step."""
        return (state["step"] + 0.5) / self.steps

    def changes_at(self, mission: TensorDictBase) -> Tensor:
        """Return the first step of the first phase that differs from the one before, ``(*B)``.

        If all are alike, that of the first phase where it is not nominal, else that of the second;
        the episode's length if it never comes.
        """
        parameters = mission["parameters"]  # (*B, P, F)
        changed = (parameters != parameters[..., :1, :]).any(-1)
        nominal = self.regime.is_identity(parameters[..., 0, :])
        alike = torch.where(nominal, min(1, changed.shape[-1] - 1), 0)
        first = torch.where(changed.any(-1), changed.int().argmax(-1), alike)
        state = {"step": torch.arange(self.steps).expand(*first.shape, -1)}
        progress, at = self.progress(mission, state), mission["at"].unsqueeze(-2)
        begun = self.schedule.phase(progress, state["step"], at)
        return (begun < first.unsqueeze(-1)).sum(-1)

    def advance(self, data: TensorDictBase, actuator: Tensor | None = None) -> TensorDict:
        """Return what one step leads to; ``actuator`` is for a noisy regime, ``(*B, A)``."""
        mission, pose = data["mission"], data["pose"]
        action, parameters = self.clamped(data), self.regime_now(mission, data)
        effective = self.effect(data, action, parameters, actuator)
        physics = self.regime.physics_of(parameters)
        moved, reward, ended = self.task.step(data, effective, physics)
        state = {"pose": moved.to(pose), "step": data["step"] + 1}
        state |= {name: data[name] for name in ("goal", "slot") if name in data.keys()}
        out = self.describe(mission, self.followed(mission, data, state, action))
        out["reward"] = reward.to(pose).unsqueeze(-1)
        return self.ended(out, ended)

    def describe(self, mission: TensorDictBase, state: dict[str, Tensor]) -> TensorDict:
        return self.described(mission, state, observation=state["pose"].clone())
