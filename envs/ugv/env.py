"""The ground robot on a track, under regimes that are hidden from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.dynamics import Dubins, DynamicsModel, MuJoCoDynamics
from afm_rl.envs.courses.track import Course, Track
from afm_rl.envs.courses.tracks import load_track
from afm_rl.envs.missions.env import MissionEnv
from afm_rl.envs.missions.format import MissionNoise
from afm_rl.envs.missions.settings import check_bounds, check_names, check_regime, listed
from afm_rl.envs.missions.simulation import BoundedSimulation
from afm_rl.errors import AFMError, check_choice, check_instance
from afm_rl.imports import check_installed
from afm_rl.options import Count, NonNegative, Positive, options
from afm_rl.regimes import ActionGain, Regime, Schedule
from afm_rl.spaces.manifold import wrap_angle


class UGVSimulation(BoundedSimulation):
    r"""Ground robots under regimes, without any state or random numbers of its own.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t)) + \epsilon_t

    The regime acts after the clamp, and its result is not clamped again. It may depend on the
    clamped actions before, and on noise. A state begins with the pose x, y, theta, the only part
    with noise; the others begin at zero. Further arguments are those
    of :class:`~afm_rl.envs.UGVTrack`.
    """

    def __init__(
        self, course: Course, world: DynamicsModel, observed: int, reach: float, **settings: Any
    ) -> None:
        super().__init__(**settings)
        self.course, self.world, self.observed, self.reach = course, world, observed, reach

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
        """Return what one step leads to, with noise of the poses (m, m, rad) ``(*B, 3)``."""
        mission, pose, before = data["mission"], data["pose"], data["reached"]
        action, parameters = self.clamped(data), self.regime_now(mission, data)
        effective = self.effect(data, action, parameters, actuator)
        moved = _wrapped(self._ahead(pose, effective, parameters) + self._whole(noise))

        track = mission["track"]
        goal = self.course.goal(track, before)
        gap = (moved[..., :2] - goal).norm(dim=-1)
        hit = (gap < self.reach) & ~self.course.finished(track, before)
        gained = (pose[..., :2] - goal).norm(dim=-1) - gap
        state = {"pose": moved, "reached": before + hit, "step": data["step"] + 1}
        out = self.describe(mission, self.followed(mission, data, state, action))
        out["reward"] = (gained + hit).unsqueeze(-1)
        return self.ended(out, self.course.finished(track, state["reached"]))

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


def _gains() -> ActionGain:
    return ActionGain(["v_gain", "omega_gain"])


class UGVTrack(MissionEnv):
    r"""Dubins robots that drive along tracks, waypoint by waypoint, batched.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t)) + \sigma \epsilon_t,
              \quad \epsilon_t \sim N(0, I)

    with the pose :math:`s = (x, y, \theta)` in m and rad, the action :math:`a = (v, \omega)` in
    m/s and rad/s, dynamics :math:`f` (Dubins, or a ``world`` whose states begin with the pose and
    have more coordinates), and a regime :math:`g` whose parameters
    :math:`\rho_t` follow the mission's progress (paper, section V-B). The next target becomes
    the goal once the robot is nearer than ``reach``, at most one per step. The reward is the
    distance gained on the current target in metres, plus 1 for a target reached. An episode
    terminates with the last target and is truncated after ``max_steps``.

    ================= ============== ====================================================
    ``observation``   ``(*B, 3)``    the pose, for policies: x, y (m), theta (rad); or as many
                                     of the state's coordinates as are ``observed``
    ``goal``          ``(*B, 2)``    current target (m)
    ``reached``       ``(*B)``       number of targets reached
    ``step``          ``(*B)``       number of steps taken
    ``since``         ``(*B)``       step at which the present phase began
    ``past``          ``(*B, D, 2)`` the last D clamped actions, newest first; only there
                                     if the regime depends on them
    ``pose``          ``(*B, 3)``    the state itself; transforms should leave it alone
    ``mission``       nested         see :class:`~afm_rl.envs.missions.format.MissionFormat`
    ``regime``        ``(*B, F)``    parameters that act on the next action: hidden truth,
                                     for oracles and logs only
    ``regime_active`` ``(*B)``       whether they differ from nominal; hidden truth as well
    ================= ============== ====================================================

    Positions are relative to the ``origin`` of the track, which is in whole kilometres and zero for
    tracks near zero. So single precision is sufficient for tracks in UTM coordinates.

    The state is in the tensordict. With ``batch_size=()`` the environment accepts
    tensordicts of any batch shape, also one that loses rows from step to step. ``reset`` keeps
    the ``mission`` entries it is given (give ``set_state=False`` for a new start and
    ``set_state=True`` to continue from ``pose``, ``reached``, ``step``, ``since`` and ``past``); an
    automatic reset repeats the mission. Noise comes from one stream per mission seed, so a mission
    has the same noise alone and in a batch. The streams are in the environment: ``set_seed``
    restarts them, a reset continues them, ``state_dict`` holds them.

    Args:
        tracks: names, CSV paths (see :func:`~afm_rl.envs.courses.tracks.load_track`) or tracks.
        regime: regime family; gains on v and omega by default.
        schedule: when regimes change; by default at 0.15 and 0.80 of the targets.
        action_low: lower bounds of v (m/s) and omega (rad/s).
        action_high: upper bounds. Actions are clamped before the regime acts on them.
        world: how the robot moves; Dubins if None.
        settings: further arguments of :class:`~afm_rl.envs.missions.env.MissionEnv`:
            ``batch_size``, ``seed``, ``device``, ``missions`` and ``dtype``.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.

    >>> env = UGVTrack(tracks=["ethz_1", "ethz_2"])
    >>> missions = [env.mission("ethz_2", seed, {"v_gain": -1.0}) for seed in range(5)]
    >>> data = env.reset(torch.stack(missions), set_state=False)
    >>> data["action"] = torch.ones(5, 2)
    >>> env.step(data)["next", "reached"]
    tensor([1, 1, 1, 1, 1])
    """

    simulation: UGVSimulation

    @options("")
    def __init__(
        self,
        tracks: Sequence[str | Path | Track] = ("ethz_2",),
        regime: Regime | None = None,
        schedule: Schedule | None = None,
        process_noise: Annotated[NonNegative, "standard deviation per step, m and rad"] = 1e-5,
        start_noise: Annotated[NonNegative, "standard deviation, m and rad"] = 0.02,
        dt: Annotated[Positive, "time step, s"] = 0.2,
        reach: Annotated[Positive, "distance at which a target counts as reached, m"] = 0.5,
        max_steps: Annotated[Count, "steps after which an episode is truncated"] = 5000,
        action_low: Sequence[float] = (-1.0, -math.pi / 2),
        action_high: Sequence[float] = (1.0, math.pi / 2),
        world: DynamicsModel | None = None,
        observed: Annotated[Count | None, "coordinates of the state; None: all"] = None,
        **settings: Any,
    ) -> None:
        super().__init__(start_noise, **settings)
        self.tracks = tuple(
            one if isinstance(one, Track) else load_track(one) for one in listed(tracks)
        )
        names = [track.name for track in self.tracks]
        check_names("tracks", names)
        self.process_noise, self.noise = process_noise, MissionNoise()
        bounds = check_bounds(action_low, action_high, ("v (m/s)", "omega (rad/s)"), self.dtype)
        schedule = Schedule() if schedule is None else schedule
        world = Dubins(dt) if world is None else world
        self.simulation = UGVSimulation(
            Course(self.tracks, self.dtype),
            world,
            observed=world.state_size if observed is None else observed,
            reach=reach,
            regime=check_regime(regime, _gains, world.state_size, 2),
            schedule=check_instance("schedule", schedule, Schedule),
            bounds=bounds,
            steps=max_steps,
        ).to(self.device)
        self._complete(names, bounds)

    @property
    def course(self) -> Course:
        """The targets of all tracks."""
        return self.simulation.course

    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        seeds = tensordict["mission", "seed"]
        noise = self.process_noise * self.noise.normal("process", seeds, dtype=self.dtype)
        return self.simulation.advance(tensordict, noise, self._actuator_noise(seeds))

    def render(
        self, tensordict: TensorDictBase | None = None, mode: str = "rgb_array"
    ) -> np.ndarray:
        """Draw the first mission, ``(H, W, 3)`` bytes.

        Args:
            tensordict: state to draw; that of the last step or reset if None.
            mode: only ``"rgb_array"``.

        Raises:
            AFMError: if there is nothing to draw yet.
        """
        check_choice("mode", mode, ["rgb_array"])
        data = self._last if tensordict is None else tensordict
        if data is None or 0 in data.batch_size:
            raise AFMError("nothing to render: call reset() first")
        check_installed("render", "matplotlib")
        from afm_rl.envs.courses.rendering import canvas_of

        first = data.reshape(-1)[0]
        canvas = canvas_of(self.tracks[int(first["mission", "track"])])
        return canvas.draw(first["pose"], first["goal"], reach=self.simulation.reach)
