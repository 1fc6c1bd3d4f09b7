"""The quadrotor that follows references, under regimes it is not told of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.airframe import QuadrotorBody
from afm_rl.dynamics.quadrotor import check_body
from afm_rl.envs import quadrotor_settings as settings
from afm_rl.envs import quadrotor_specs as specs
from afm_rl.envs.flight_noise import FlightNoise
from afm_rl.envs.mission_env import MissionEnv, check_action
from afm_rl.envs.missions import MissionFormat
from afm_rl.envs.quadrotor_simulation import QuadrotorSimulation
from afm_rl.envs.references import Reference
from afm_rl.envs.ugv_settings import check_batch, check_dtype, check_missions
from afm_rl.envs.ugv_specs import done_spec, reward_spec
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag, check_number
from afm_rl.regimes import Regime, Schedule


class CrazyflieTrack(MissionEnv):
    r"""Quadrotors that follow position references, tick by tick, batched.

    The plant is the rigid body of :func:`~afm_rl.dynamics.quadrotor_equations.quadrotor_rate`,
    integrated at 500 Hz while the action :math:`u = (T, M_x, M_y, M_z)` in N and N m is held for a
    control tick of 50 ms. What the motors can give of it, :func:`~afm_rl.airframe.saturate`, goes
    through a regime whose parameters follow the mission's phases. There is no ground, no drag and
    no motor lag. The reward is minus the squared distance to the reference (m^2), averaged over
    the tick. A flight is truncated after ``duration``; it terminates when it is lost: further than
    ``limit`` from the reference, or no longer finite. It then stays at the last good state.

    ================= ================ ==================================================
    ``observation``   ``(*B, 13)``     position (m), velocity (m/s), quaternion
                                       (scalar-last), body rate (rad/s), with sensor noise
    ``reference``     ``(*B, N+1, 6)`` position and velocity to aim for, now and after
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
    ``mission``       nested           see :class:`~afm_rl.envs.missions.MissionFormat`;
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
        references: references or CSV paths (see :func:`~afm_rl.envs.references.load_reference`);
            a circle of 2 m at 0.8 m/s if None.
        regime: regime family; all of :func:`~afm_rl.regimes.flight_regimes` if None.
        schedule: when regimes change: a schedule, or times in s; at 2 s and 5 s if None.
        body: the quadrotor, a Crazyflie if None.
        duration: length of a flight (s).
        horizon: ticks N by which ``reference`` looks ahead.
        preview: whether it holds the future; otherwise it repeats the present set-point.
        start: ``"moving"``, with the velocity of the reference, or ``"rest"``. Either starts at
            the reference, level.
        limit: distance from the reference at which a flight is lost (m).
        sensor_noise: standard deviation in ``observation``: one number, or four for position
            (m), velocity (m/s), attitude (rad) and body rate (rad/s).
        start_noise: standard deviation of the start position per axis (m).
        dt: control tick (s).
        substeps: plant steps per tick, K.
        trace: whether to publish the states in between.
        batch_size: number of flights, or ``()`` for any.
        seed: missions without a seed of their own get ``seed, seed + 1, ...``.
        device: where the tensors live.
        missions: what missions are unless ``reset`` is told otherwise: a tensordict that
            broadcasts to ``batch_size``, or the arguments of :meth:`mission`.
        action_low: lowest action, ``(4,)``; what the motors can do if None.
        action_high: highest action.
        dtype: floating-point type, torch's default if None.

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

    def __init__(
        self,
        references: Sequence[Reference | str | Path] | Reference | str | Path | None = None,
        regime: Regime | None = None,
        schedule: Schedule | Sequence[float] | None = None,
        body: QuadrotorBody | None = None,
        duration: float = 8.0,
        horizon: int = 20,
        preview: bool = True,
        start: str = "moving",
        limit: float = 50.0,
        sensor_noise: float | Sequence[float] = 0.0,
        start_noise: float = 0.0,
        dt: float = 0.05,
        substeps: int = 25,
        trace: bool = False,
        batch_size: Sequence[int] = (),
        seed: int = 0,
        device: torch.device | str | None = None,
        missions: TensorDictBase | Mapping[str, Any] | None = None,
        *,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        batch = check_batch(batch_size)
        super().__init__(device=device, batch_size=batch)
        self._batch_locked = bool(batch)
        self.dtype = check_dtype(dtype)
        self.references = settings.check_references(references)
        self.body = check_body(body)
        self.regime = settings.check_flight_regime(regime, self.body)
        self.start_noise = check_number("start_noise", start_noise, low=0.0)
        self.seed = check_count("seed", seed, low=0)
        substeps = check_count("substeps", substeps)
        self.noise = FlightNoise(between=substeps - 1)
        dt = check_number("dt", dt, low=0.0, open_low=True)
        self.schedule = settings.check_flight_schedule(schedule, dt)
        self.simulation = QuadrotorSimulation(
            references=self.references,
            regime=self.regime,
            schedule=self.schedule,
            body=self.body,
            dt=dt,
            substeps=substeps,
            steps=settings.check_steps(duration, dt),
            horizon=check_count("horizon", horizon),
            preview=check_flag("preview", preview),
            start=check_choice("start", start, ("rest", "moving")),
            limit=check_number("limit", limit, low=0.0, open_low=True),
            sensor_noise=settings.check_sensor_noise(sensor_noise),
            trace=check_flag("trace", trace),
        )

        names = [reference.name for reference in self.references]
        self.mission_format = MissionFormat(names, self.regime, self.schedule, self.dtype)
        if isinstance(missions, Mapping) and not isinstance(missions, TensorDictBase):
            for key in missions:
                known = ("track", "seed", "regime", "at", "ramp", "times")
                check_choice("missions", key, known)
            missions = self.mission(**missions)
        self._default = check_missions(missions, batch)
        self._missions_of(None, batch)  # a wrong default fails here, not at the first reset

        mission = self.mission_format.spec(batch, self.device)
        state = specs.state_spec(mission, self.dtype, self.regime.history)
        self.state_spec = state
        self.observation_spec = specs.observation_spec(
            state, self.simulation.horizon, len(self.regime.names), substeps + 1 if trace else None
        )
        bounds = settings.check_action_box(action_low, action_high, self.body)
        self.full_action_spec = specs.action_spec(bounds, state)
        self.full_reward_spec = reward_spec(state)
        self.full_done_spec = done_spec(state)

    def mission(
        self,
        track: int | str = 0,
        seed: int | None = None,
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        at: Sequence[float] | None = None,
        ramp: int = 0,
        times: Sequence[float] | None = None,
    ) -> TensorDict:
        """Describe one mission; see :meth:`~afm_rl.envs.missions.MissionFormat.build`.

        Args:
            track: index or name of the reference.
            seed: seed of its noise.
            regime: parameters that are not nominal, for the second phase or for each.
            at: breakpoints in the unit of the schedule: a phase begins beyond them.
            ramp: ticks that a change takes.
            times: breakpoints in s instead: a phase begins with the first tick from then on.

        Raises:
            ConfigurationError: for a value that cannot be used.
        """
        if times is not None:
            if at is not None:
                raise ConfigurationError(f"missions: at={at!r}, times={times!r}: expected one")
            whole = self.simulation.steps if self.schedule.by == "progress" else 1
            at = [tick / whole for tick in settings.ticks(times, self.simulation.dt)]
        return self.mission_format.build(track, seed, regime, at, ramp).to(self.device)

    def _missions_of(self, given: TensorDictBase | None, batch: torch.Size) -> TensorDict:
        mission = super()._missions_of(given, batch)
        settings.check_parameters(self.regime, mission["parameters"])
        return mission

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **kwargs
    ) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = TensorDict({}, batch) if tensordict is None else tensordict
        mission = self._missions_of(given, batch)
        rows = given.get("_reset", None)
        rows = None if rows is None else rows.reshape(batch)
        state = self.simulation.begin(mission, self.dtype)
        if set_state and "pose" in given.keys():
            settings.check_pose(given["pose"])
            state = {
                name: given.get(name, value).to(value.dtype, copy=True)
                for name, value in state.items()
            }
        elif self.start_noise:
            moved = self.noise.normal("start", mission["seed"], rows, self.dtype)
            state["pose"][..., :3] += self.start_noise * moved
        sensor = self._sensor(mission["seed"], rows)
        return self._remembered(self.simulation.describe(mission, state, sensor))

    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        check_action(tensordict["action"])
        seeds = tensordict["mission", "seed"]
        actuator = None
        if self.regime.noisy:
            actuator = self.noise.normal("actuator", seeds, dtype=self.dtype)
        between = self._sensor(seeds, event="between") if self.simulation.trace else None
        return self.simulation.advance(tensordict, self._sensor(seeds), between, actuator)

    def _sensor(
        self, seeds: Tensor, rows: Tensor | None = None, event: str = "sensor"
    ) -> Tensor | None:
        if not self.simulation.sensor_noise.any():
            return None
        return self.noise.normal(event, seeds, rows, self.dtype)
