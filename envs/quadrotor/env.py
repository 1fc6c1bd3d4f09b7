"""The quadrotor that follows references, under regimes that are hidden from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.dynamics.quadrotor import check_body
from afm_rl.envs.courses.flights import Reference, check_reference, find_reference
from afm_rl.envs.missions.env import MissionEnv
from afm_rl.envs.missions.format import flight_noise
from afm_rl.envs.missions.gym import MissionGym
from afm_rl.envs.missions.settings import (
    check_bounds,
    check_names,
    check_regime,
    listed,
    schedule_in_seconds,
    steps_at,
)
from afm_rl.envs.quadrotor.simulation import QuadrotorSimulation
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, NonNegative, Positive, options
from afm_rl.regimes import Regime, Schedule, flight_regimes
from afm_rl.spaces.airframe import QuadrotorBody


class CrazyflieTrack(MissionEnv):
    r"""Quadrotors that follow position references, tick by tick, batched.

    The plant is the rigid body of :func:`~afm_rl.dynamics.quadrotor.quadrotor_rate`,
    integrated at 500 Hz while the action :math:`u = (T, M_x, M_y, M_z)` in N and N m is held for a
    control tick of 50 ms. The action is limited to the motors' range
    (:func:`~afm_rl.spaces.airframe.within_motors`) and then changed by a regime whose parameters
    follow the mission's phases. There is no ground, no drag and no motor lag. The reward is minus
    the squared distance to the reference (m^2), averaged over the tick. A flight is truncated after
    ``duration``; it terminates when it is lost: further than ``limit`` from the reference, or no
    longer finite. It then stays at the last good state.

    ================= ================ ==================================================
    ``observation``   ``(*B, 13)``     position (m), velocity (m/s), quaternion
                                       (scalar-last), body rate (rad/s), with sensor noise
    ``reference``     ``(*B, N+1, 6)`` position and velocity of the reference, now and after
                                       each of the next N ticks
    ``trace``         ``(*B, K+1, 13)`` with ``trace=True``: the observation before the last
                                       tick, after each of its K plant steps but the last,
                                       and after the tick; for learners
    ``square_error``  ``(*B, 3)``      mean over the last tick's plant steps of the squared
                                       error per axis (m^2); this and ``reference`` are
                                       one plant step ahead, as in the published metric
    ``step``          ``(*B)``         number of ticks flown
    ``since``         ``(*B)``         tick at which the present phase began
    ``lost``          ``(*B)``         whether the flight is lost
    ``past``          ``(*B, D, 4)``   the last D saturated actions, newest first; only
                                       there if the regime depends on them
    ``pose``          ``(*B, 13)``     the state itself; transforms should leave it alone
    ``mission``       nested           see :class:`~afm_rl.envs.missions.format.MissionFormat`;
                                       ``track`` is the index of the reference
    ``phase``         ``(*B)``         index of the present phase; hidden truth
    ``regime``        ``(*B, F)``      parameters that act on the next action: hidden
                                       truth, for oracles and logs only
    ``regime_active`` ``(*B)``         whether they differ from nominal; hidden as well
    ================= ================ ==================================================

    State, missions, resets and noise streams work as in :class:`~afm_rl.envs.UGVTrack`: with
    ``batch_size=()`` a tensordict may hold any number of flights. A mass of 50 % is within the
    published study, but a bare Crazyflie cannot lose it; 133 % is a payload of 10 g.

    Args:
        tracks: references, or their names (see :func:`~afm_rl.envs.find_reference`), such as
            ``circle_2m_0.8mps`` (radius, speed) or the path of a CSV file.
        regime: regime family; all of :func:`~afm_rl.regimes.flight_regimes` if None.
        schedule: when regimes change: a schedule, or times in s; at 2 s and 5 s if None.
        body: the quadrotor, a Crazyflie if None.
        action_low: lowest action, ``(4,)``; what the motors can do if None.
        action_high: highest action.
        settings: further arguments of :class:`~afm_rl.envs.missions.env.MissionEnv`:
            ``batch_size``, ``seed``, ``device``, ``missions`` and ``dtype``.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.

    >>> env = CrazyflieTrack()
    >>> changes = [{}, {"mass": 0.5}, {"mass": 4 / 3}]
    >>> missions = [env.mission(seed=seed, regime=changes) for seed in range(5)]
    >>> data = env.reset(torch.stack(missions), set_state=False)
    >>> data["action"] = torch.tensor([0.2943, 0, 0, 0]).expand(5, 4)
    >>> env.step(data)["next", "reference"].shape
    torch.Size([5, 21, 6])
    """

    simulation: QuadrotorSimulation
    plant: type[QuadrotorSimulation] = QuadrotorSimulation
    more = ("times",)

    @options("")
    def __init__(
        self,
        tracks: Sequence[Reference | str | Path] | Reference | str | Path = "circle_2m_0.8mps",
        regime: Regime | None = None,
        schedule: Schedule | Sequence[float] | None = None,
        body: QuadrotorBody | None = None,
        duration: Annotated[Positive, "duration of a flight, s, a multiple of dt"] = 8.0,
        horizon: Annotated[Count, "length of the preview of the reference, ticks, N"] = 20,
        preview: Annotated[
            bool, "False: only the current set-point is known, as in published flights"
        ] = True,
        start: Annotated[
            Literal["moving", "rest"] | None,
            "initial state; None: at rest without preview, otherwise moving as the reference",
        ] = None,
        limit: Annotated[
            Positive, "distance from the reference at which a flight is lost, m"
        ] = 50.0,
        sensor_noise: Annotated[
            NonNegative | Sequence[NonNegative], "standard deviation, or four: m, m/s, rad, rad/s"
        ] = 0.0,
        start_noise: Annotated[NonNegative, "standard deviation of the initial position, m"] = 0.0,
        dt: Annotated[Positive, "control tick, s"] = 0.05,
        substeps: Annotated[Count, "steps of the plant per tick, K"] = 25,
        trace: Annotated[
            bool, "publish the integration steps of the plant, for updater=knode"
        ] = False,
        max_steps: Annotated[Count, "largest length of a flight, ticks"] = 5000,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(start_noise, **settings)
        self.references = tuple(
            find_reference(str(one)) if isinstance(one, (str, Path)) else check_reference(one)
            for one in listed(tracks)
        )
        names = [reference.name for reference in self.references]
        check_names("tracks", names)
        self.body = check_body(body)
        self.noise = flight_noise(between=substeps - 1)
        if not isinstance(schedule, Schedule):
            schedule = schedule_in_seconds((2.0, 5.0) if schedule is None else schedule, dt)
        if start is None:
            start = "moving" if preview else "rest"
        self.simulation = self.plant(
            references=self.references,
            regime=check_regime(regime, lambda: flight_regimes(self.body), 13, 4),
            schedule=schedule,
            body=self.body,
            dt=dt,
            substeps=substeps,
            steps=min(_ticks(duration, dt), max_steps),
            horizon=horizon,
            preview=preview,
            start=start,
            limit=limit,
            sensor_noise=_sensor_noise(sensor_noise),
            trace=trace,
        )
        pairs = zip((action_low, action_high), self.body.bounds, strict=True)
        low, high = (most if given is None else given for given, most in pairs)
        actions = ("thrust (N)", *(f"moment_{axis} (N m)" for axis in "xyz"))
        self._complete(names, check_bounds(low, high, actions, self.dtype))

    def mission(
        self, *args: Any, times: Sequence[float] | None = None, **entries: Any
    ) -> TensorDict:
        """Describe one mission; see :meth:`~afm_rl.envs.missions.format.MissionFormat.build`.

        Args:
            args: as there; the track is the reference. times: breakpoints in s instead of ``at``: a
            phase begins with the first tick from then on. entries: as there.

        Raises:
            ConfigurationError: for a value that cannot be used.
        """
        if times is not None:
            if entries.get("at") is not None:
                raise ConfigurationError(
                    f"missions: at={entries['at']!r}, times={times!r}: expected one"
                )
            whole = self.simulation.steps if self.schedule.by == "progress" else 1
            entries["at"] = [tick / whole for tick in steps_at(times, self.simulation.dt)]
        return super().mission(*args, **entries)

    def _check_pose(self, pose: Tensor) -> None:
        if pose.shape[-1] != 13 or not pose.isfinite().all():
            raise ConfigurationError(
                f"pose {tuple(pose.shape)}: expected 13 finite numbers per flight: position, "
                "velocity, quaternion (scalar-last), body rate"
            )
        length = pose[..., 6:10].norm(dim=-1).reshape(-1)
        rows = (length - 1).abs().gt(1e-3).nonzero().flatten().tolist()
        if rows:
            raise ConfigurationError(
                f"pose: quaternions of flights {rows}: length {length[rows[0]].item():g}, "
                "expected 1"
            )

    def _described(
        self, mission: TensorDictBase, state: dict[str, Tensor], rows: Tensor | None
    ) -> TensorDictBase:
        return self.simulation.describe(mission, state, self._sensor(mission["seed"], rows))

    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        seeds = tensordict["mission", "seed"]
        actuator = self._actuator_noise(seeds)
        between = self._sensor(seeds, event="between") if self.simulation.trace else None
        return self.simulation.advance(tensordict, self._sensor(seeds), between, actuator)

    def _sensor(
        self, seeds: Tensor, rows: Tensor | None = None, event: str = "sensor"
    ) -> Tensor | None:
        if not self.simulation.sensor_noise.any():
            return None
        return self.noise.normal(event, seeds, rows, self.dtype)


def _ticks(duration: float, dt: float) -> int:
    """Return the number of control ticks in a flight, whose duration (s) must be a multiple."""
    steps = round(duration / dt)
    if steps < 1 or abs(steps * dt - duration) > 1e-6 * duration:
        raise ConfigurationError(f"duration={duration!r}: expected a multiple of dt={dt!r} s")
    return steps


def _sensor_noise(std: float | Sequence[float]) -> Tensor:
    """Return standard deviations ``(12,)`` from one number, or four: position, velocity, ..."""
    given = list(std) if isinstance(std, Sequence) and not isinstance(std, str) else [std] * 4
    if len(given) != 4:
        raise ConfigurationError(f"sensor_noise={std!r}: expected one number, or four")
    return torch.tensor(given, dtype=torch.float64).repeat_interleave(3)


class CrazyflieTrackGym(MissionGym):
    """One mission of :class:`~afm_rl.envs.CrazyflieTrack`.

    The observation holds the state (position in m, velocity in m/s, quaternion, body rate in rad/s)
    and the present reference (position, velocity), the action thrust (N) and moments (N m). The
    info holds the time (s), the squared error per axis of the last tick (m^2) and, as a truth
    hidden from the observation, ``regime_active``.

    Args:
        reference: a reference or the path of a CSV file; a circle if None.
        regime: regime parameters of the changed phase, or one mapping per phase.
        times: when phases begin (s); at 2 s and 5 s if None.
        ramp: ticks over which the regime changes; 0 for sudden changes.
        render_mode: None; there is nothing to see.
        settings: further arguments of :class:`~afm_rl.envs.CrazyflieTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.

    >>> import gymnasium, afm_rl  # registers the name
    >>> env = gymnasium.make("afm_rl/CrazyflieTrack-v0", regime={"mass": 0.5}, times=[2.0])
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, info["time"]
    ((19,), 0.0)
    """

    native: CrazyflieTrack
    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 20}

    def __init__(
        self,
        reference: Reference | str | Path | None = None,
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        times: Sequence[float] | None = None,
        ramp: int = 0,
        render_mode: None = None,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            raise ConfigurationError(f"render_mode={render_mode!r}: expected none")
        missions = {"regime": regime, "ramp": ramp}
        tracks = "circle_2m_0.8mps" if reference is None else reference
        settings.setdefault("start", "moving")
        native = CrazyflieTrack(tracks, schedule=times, missions=missions, **settings)
        super().__init__(native, [np.inf] * 19)

    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        info = {
            "time": data["step"].double() * self.native.simulation.dt,
            "square_error": data["square_error"],
            "regime_active": data["regime_active"],
        }
        return torch.cat([data["observation"], data["reference"][..., 0, :]], -1), info
