"""The ground robot on a track, under regimes it is not told of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from afm_rl.envs import ugv_settings as settings
from afm_rl.envs import ugv_specs as specs
from afm_rl.envs.course import Course
from afm_rl.envs.mission_env import MissionEnv, check_action
from afm_rl.envs.mission_noise import MissionNoise
from afm_rl.envs.missions import MissionFormat
from afm_rl.envs.rendering import canvas_of
from afm_rl.envs.track import Track
from afm_rl.envs.ugv_simulation import UGVSimulation
from afm_rl.errors import (
    AFMError,
    check_choice,
    check_count,
    check_number,
)
from afm_rl.regimes import Regime, Schedule


class UGVTrack(MissionEnv):
    r"""Dubins robots that drive along tracks, waypoint by waypoint, batched.

    .. math:: s_{t+1} = f(s_t, g(\mathrm{clamp}(a_t); \rho_t)) + \sigma \epsilon_t,
              \quad \epsilon_t \sim N(0, I)

    with the pose :math:`s = (x, y, \theta)` in m and rad, the action :math:`a = (v, \omega)` in
    m/s and rad/s, Dubins dynamics :math:`f`, and a regime :math:`g` whose parameters
    :math:`\rho_t` follow the mission's progress (paper, section V-B). The next target becomes
    the goal once the robot is nearer than ``reach``, at most one per step. The reward is the
    distance gained on the current target in metres, plus 1 for a target reached. An episode
    terminates with the last target and is truncated after ``max_steps``.

    ================= ============== ====================================================
    ``observation``   ``(*B, 3)``    the pose, for policies: x, y (m), theta (rad)
    ``goal``          ``(*B, 2)``    current target (m)
    ``reached``       ``(*B)``       number of targets reached
    ``step``          ``(*B)``       number of steps taken
    ``since``         ``(*B)``       step at which the present phase began
    ``past``          ``(*B, D, 2)`` the last D clamped actions, newest first; only there
                                     if the regime depends on them
    ``pose``          ``(*B, 3)``    the state itself; transforms should leave it alone
    ``mission``       nested         see :class:`~afm_rl.envs.missions.MissionFormat`
    ``regime``        ``(*B, F)``    parameters that act on the next action: hidden truth,
                                     for oracles and logs only
    ``regime_active`` ``(*B)``       whether they differ from nominal; hidden truth as well
    ================= ============== ====================================================

    The state travels in the tensordict. With ``batch_size=()`` the environment accepts
    tensordicts of any batch shape, also one that loses rows from step to step. ``reset`` keeps
    the ``mission`` entries it is given (say ``set_state=False`` for a fresh start and
    ``set_state=True`` to go on from ``pose``, ``reached``, ``step``, ``since`` and ``past``); an
    automatic reset repeats the mission. Noise comes from one stream per mission seed, so a mission
    meets the same noise alone as in a batch. The streams live in the environment: ``set_seed``
    restarts them, a reset continues them, ``state_dict`` holds them.

    Args:
        tracks: names, CSV paths (see :func:`~afm_rl.envs.tracks.load_track`) or tracks.
        regime: regime family; gains on v and omega by default.
        schedule: when regimes change; by default at 0.15 and 0.80 of the targets.
        process_noise: standard deviation per step of each pose component (m, m, rad).
        start_noise: the same for the start pose.
        dt: time step (s).
        reach: distance at which a target counts as reached (m).
        max_steps: steps after which an episode is truncated.
        action_low: lower bounds of v (m/s) and omega (rad/s).
        action_high: upper bounds. Actions are clamped before the regime acts on them.
        batch_size: number of missions, or ``()`` for any.
        seed: missions without a seed of their own get ``seed, seed + 1, ...``.
        device: where the tensors live.
        missions: what missions are unless ``reset`` is told otherwise: a tensordict that
            broadcasts to ``batch_size``, or the arguments of :meth:`mission`.
        dtype: floating-point type, torch's default if None.

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

    def __init__(
        self,
        tracks: Sequence[str | Path | Track] = ("ethz_2",),
        regime: Regime | None = None,
        schedule: Schedule | None = None,
        process_noise: float = 1e-5,
        start_noise: float = 0.02,
        dt: float = 0.2,
        reach: float = 0.5,
        max_steps: int = 5000,
        action_low: Sequence[float] = (-1.0, -math.pi / 2),
        action_high: Sequence[float] = (1.0, math.pi / 2),
        batch_size: Sequence[int] = (),
        seed: int = 0,
        device: torch.device | str | None = None,
        missions: TensorDictBase | Mapping[str, Any] | None = None,
        *,
        dtype: torch.dtype | None = None,
    ) -> None:
        batch = settings.check_batch(batch_size)
        super().__init__(device=device, batch_size=batch)
        self._batch_locked = bool(batch)
        self.dtype = settings.check_dtype(dtype)
        self.tracks = settings.load_tracks(tracks)
        self.regime = settings.check_regime(regime)
        self.schedule = settings.check_schedule(schedule)
        self.process_noise = check_number("process_noise", process_noise, low=0.0)
        self.start_noise = check_number("start_noise", start_noise, low=0.0)
        self.seed = check_count("seed", seed, low=0)
        self.noise = MissionNoise()
        low, high = settings.action_box(action_low, action_high)
        self.simulation = UGVSimulation(
            Course(self.tracks, self.dtype),
            regime=self.regime,
            schedule=self.schedule,
            low=low.to(self.dtype),
            high=high.to(self.dtype),
            dt=check_number("dt", dt, low=0.0, open_low=True),
            reach=check_number("reach", reach, low=0.0, open_low=True),
            max_steps=check_count("max_steps", max_steps),
        ).to(self.device)

        names = [track.name for track in self.tracks]
        self.mission_format = MissionFormat(names, self.regime, self.schedule, self.dtype)
        if isinstance(missions, Mapping) and not isinstance(missions, TensorDictBase):
            for key in missions:
                check_choice("missions", key, ("track", "seed", "regime", "at", "ramp"))
            missions = self.mission(**missions)
        self._default = settings.check_missions(missions, batch)
        self._missions_of(None, batch)  # a wrong default fails here, not at the first reset

        mission = self.mission_format.spec(batch, self.device)
        state = specs.state_spec(mission, self.dtype, self.regime.history)
        self.state_spec = state
        self.observation_spec = specs.observation_spec(state, len(self.regime.names))
        self.full_action_spec = specs.action_spec(
            self.simulation.low, self.simulation.high, batch, self.device
        )
        self.full_reward_spec = specs.reward_spec(state)
        self.full_done_spec = specs.done_spec(state)

    @property
    def course(self) -> Course:
        """The targets of all tracks."""
        return self.simulation.course

    def mission(
        self,
        track: int | str = 0,
        seed: int | None = None,
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        at: Sequence[float] | None = None,
        ramp: int = 0,
    ) -> TensorDict:
        """Describe one mission; see :meth:`~afm_rl.envs.missions.MissionFormat.build`."""
        return self.mission_format.build(track, seed, regime, at, ramp).to(self.device)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **kwargs
    ) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = TensorDict({}, batch) if tensordict is None else tensordict
        mission = self._missions_of(given, batch)
        nothing = torch.zeros_like(mission["track"])
        state = {"reached": nothing, "step": nothing, "since": nothing}
        if self.regime.history:
            size = (*batch, self.regime.history, 2)
            state["past"] = torch.zeros(size, dtype=self.dtype, device=self.device)
        if set_state and "pose" in given.keys():
            pose = given["pose"].to(self.dtype, copy=True)
            state = {name: given.get(name, value) for name, value in state.items()}
        else:
            rows = given.get("_reset", None)
            rows = None if rows is None else rows.reshape(batch)
            noise = self.noise.normal("start", mission["seed"], rows, self.dtype)
            pose = self.simulation.start(mission, self.start_noise * noise)
        state = {name: value.clone() for name, value in state.items()}
        return self._remembered(self.simulation.describe(mission, pose, **state))

    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        check_action(tensordict["action"])
        seeds = tensordict["mission", "seed"]
        noise = self.noise.normal("process", seeds, dtype=self.dtype)
        actuator = None
        if self.regime.noisy:
            actuator = self.noise.normal("actuator", seeds, dtype=self.dtype)
        return self.simulation.advance(tensordict, self.process_noise * noise, actuator)

    def _remembered(self, out: TensorDictBase) -> TensorDictBase:
        self._last = out.select("pose", "goal", "mission")
        return out

    def render(
        self, tensordict: TensorDictBase | None = None, mode: str = "rgb_array"
    ) -> np.ndarray:
        """Draw the first mission, ``(H, W, 3)`` bytes.

        Args:
            tensordict: what to draw; the outcome of the last step or reset if None.
            mode: only ``"rgb_array"``.

        Raises:
            AFMError: if there is nothing to draw yet.
        """
        check_choice("mode", mode, ["rgb_array"])
        data = self._last if tensordict is None else tensordict
        if data is None or 0 in data.batch_size:
            raise AFMError("nothing to render: call reset() first")
        first = data.reshape(-1)[0]
        canvas = canvas_of(self.tracks[int(first["mission", "track"])])
        return canvas.draw(first["pose"], first["goal"], reach=self.simulation.reach)
