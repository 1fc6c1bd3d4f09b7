"""MuJoCo as a dynamics model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, cast

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics.action_map import ActionMap, check_range, gain_and_offset
from afm_rl.dynamics.base import closed_form
from afm_rl.dynamics.known import KnownDynamics, PhysicsModel
from afm_rl.dynamics.mujoco_model import (
    HUGE,
    actuator_names,
    changed_model,
    control_range,
    home_of,
    host_of,
    read_model,
    space_of,
    state_names,
)
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, Natural, Positive, options
from afm_rl.regimes import Physics

try:
    import mujoco
    from mujoco import rollout as mujoco_rollout
except ImportError:  # an extra
    mujoco = None

STEP = 1e-4  # of finite differences, in half ranges and units of the state: far above the
# tolerance of the contact solver, far below what bends a trajectory
Change = Callable[[Any, tuple[float, ...]], Any]


class Simulator:
    """Simulates copies of an ``MjModel``, ``frame_skip`` steps per action, on some threads.

    ``change`` makes models with other physics, of which the ``most`` latest are kept; the row
    ``nominal`` changes nothing.
    """

    def __init__(
        self,
        model: Any,
        frame_skip: int,
        threads: int,
        change: Change = changed_model,
        nominal: tuple[float, ...] = Physics.identity,
        most: int = 1024,
    ) -> None:
        self.settings = model, frame_skip, threads, change, nominal, most
        self.data = [mujoco.MjData(model) for _ in range(max(1, threads))]
        self.pool = mujoco_rollout.Rollout(nthread=threads)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.rest = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, self.data[0], self.rest, kind)
        self.changed: dict[tuple[float, ...], Any] = {}
        self.accelerations: list[dict[bytes, np.ndarray]] = []  # by state, of the newest two calls
        self.state = slice(1, 1 + model.nq + model.nv + model.na)  # the time stands before it

    def __reduce__(self):  # threads can neither be copied nor sent to another process
        return type(self), self.settings

    def __deepcopy__(self, memo: dict) -> Simulator:
        return type(self)(*self.settings)

    def models(self, physics: np.ndarray) -> list[Any]:
        """Return the model of each row of physics ``(N, P)``, made when it is first met."""
        model, _, _, change, nominal, most = self.settings
        if len(self.changed) > most:
            self.changed.clear()
        rows = [tuple(row) for row in physics.tolist()]
        for row in set(rows) - self.changed.keys():
            self.changed[row] = model if row == nominal else change(model, row)
        return [self.changed[row] for row in rows]

    def warm_start(self, states: np.ndarray, accelerations: np.ndarray) -> None:
        """Begin from these states ``(N, S)`` with what the solver had found, ``(N, V)``.

        Kept until the next but one call, which is about the states that follow the next.
        """
        found = {row.tobytes(): acc for row, acc in zip(states, accelerations, strict=True)}
        self.accelerations = [*self.accelerations[-1:], found]

    def _warm(self, states: np.ndarray) -> np.ndarray | None:
        """Return the accelerations ``(N, V)`` that solvers begin with; zeros if not known."""
        known = {row: acc for found in self.accelerations for row, acc in found.items()}
        rows = [known.get(row.tobytes()) for row in states] if known else []
        if all(row is None for row in rows):
            return None
        none = np.zeros(self.settings[0].nv)
        return np.stack([none if row is None else row for row in rows])

    def __call__(
        self, states: np.ndarray, controls: np.ndarray, physics: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the states ``(N, H, S)`` that controls ``(N, H, A)`` lead to from ``(N, S)``.

        From the first number on that is not finite, or huge, a row is NaN, and costs nothing. With
        ``physics`` ``(N, P)`` each row has its own, see :class:`~afm_rl.regimes.Physics`.
        """
        model, skip = self.settings[:2]
        sound = (np.abs(controls).max(-1) < HUGE) & (np.abs(states).max(-1) < HUGE)[:, None]
        if not sound.all():
            after = np.full((*sound.shape, states.shape[1]), np.nan)
            lengths = np.logical_and.accumulate(sound, 1).sum(1)
            for length in {*lengths.tolist()} - {0}:
                rows = lengths == length
                changed = None if physics is None else physics[rows]
                after[rows, :length] = self(states[rows], controls[rows, :length], changed)
            return after
        if len(states) == 0:  # MuJoCo would crash
            return np.empty((0, controls.shape[1], states.shape[1]))
        if physics is not None:
            model = self.models(physics)
        full = np.repeat(self.rest[None], len(states), 0)
        full[:, self.state] = states
        warm = self._warm(states)
        controls = np.repeat(controls, skip, 1)
        after, _ = self.pool.rollout(model, self.data, full, controls, initial_warmstart=warm)
        return after[:, skip - 1 :: skip, self.state]


class MuJoCoDynamics(KnownDynamics, PhysicsModel):
    r"""A MuJoCo model as dynamics, for the robot or its nominal model.

    States are :math:`(q, \dot q, w)`: positions, velocities and the actuators' activations;
    actions are the controls. Plans are simulated in one call, on some threads, in double
    precision; derivatives are finite differences of such simulations. Autograd cannot
    differentiate through the simulation.

    Controls beyond their range are not clipped, because an effective action may be there.

    Args:
        model: MJCF file or string, ``MjModel``, or environment of gymnasium or dm_control; copied,
            so later changes of the environment's physics do not affect it. An MJCF need not be
            trusted: a child process compiles it, within 5 s of work and 2 GiB. For larger models,
            and for your own plugins, load the ``MjModel`` yourself.
        change: ``change(model, row)`` returns the model with other physics, by a row ``(P,)`` of
            :class:`~afm_rl.regimes.Physics`.
        physics: names of the physical parameters that may change, with their nominal values; by
            default those of :class:`~afm_rl.regimes.Physics`.
        action_map: the map of an environment from actions to controls, :math:`u = k a + b`:
            ``"range"`` (actions from -1 to 1 span the range of the controls), or gains k, one for
            each action or a matrix ``(U, A)``, and offsets b ``(U,)``; None: actions are controls.

    Raises:
        ConfigurationError: if MuJoCo or the model is missing, or the model cannot be simulated.

    >>> cart = '''<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body>
    ... </worldbody><actuator><motor joint="x"/></actuator></mujoco>'''
    >>> model = MuJoCoDynamics(cart, frame_skip=5)
    >>> model(torch.zeros(3, 2), torch.ones(3, 1)).shape
    torch.Size([3, 2])
    >>> model.rollout(torch.zeros(2), torch.ones(64, 20, 1)).shape
    torch.Size([64, 20, 2])
    """

    extrapolates = True
    stiff = True
    skips_nan = True
    gain: Tensor | None
    offset: Tensor | None

    @options("dynamics")
    def __init__(
        self,
        model: Any,
        frame_skip: Annotated[
            Count | None, "simulation steps per action; None: those of the environment"
        ] = None,
        noise_std: Annotated[
            Positive | Sequence[Positive],
            "standard deviation of a prediction, positions and velocities",
        ] = (0.01, 0.1),
        threads: Annotated[Natural, "additional threads for simulation"] = 0,
        change: Change = changed_model,
        physics: Mapping[str, float] = dict(zip(Physics.names, Physics.identity, strict=True)),
        action_map: ActionMap | None = None,
    ) -> None:
        mujoco_model, skip = read_model(model)
        mujoco_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        skip = skip if frame_skip is None else frame_skip
        nominal = tuple(physics.values())
        simulator: Any = Simulator(mujoco_model, skip, threads, change, nominal)
        if not isinstance(noise_std, int | float) and len(noise_std) == 2:
            position, velocity = noise_std
            noise_std = (
                [position] * mujoco_model.nv
                + [velocity] * mujoco_model.nv
                + [position] * mujoco_model.na
            )
        start = simulator.rest[None, simulator.state]
        if not np.isfinite(simulator(start, np.zeros((1, 1, mujoco_model.nu)))).all():
            raise ConfigurationError(
                f"dynamics.model={str(model)[:80]!r}: its first step leads to numbers that are not "
                "finite; check its time step, damping, stiffness, and contacts"
            )
        ends = torch.from_numpy(control_range(mujoco_model))
        low, high = ends
        gain, offset = gain_and_offset(action_map, low, high) if action_map else (None, None)
        matrix = gain is not None and gain.dim() == 2
        size = cast(Tensor, gain).shape[1] if matrix else mujoco_model.nu
        super().__init__(simulator, space_of(mujoco_model), size, noise_std)
        # A derivative takes A simulations; to begin with an old one, two more rounds.
        self.keeps_derivative = size > 8
        self.register_buffer("gain", gain, persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.mapped = action_map not in (None, "range")
        self._name_physics(physics)
        self.mjcf = mujoco_model
        self.dt = skip * float(mujoco_model.opt.timestep)
        now = getattr(host_of(model), "data", None)
        self.home = self.home_at(None if now is None else now.qpos)
        if matrix:  # no single actuator limits an action
            ends = ends.new_tensor([[-torch.inf], [torch.inf]]).expand(2, size)
        elif gain is not None and offset is not None:
            ends = ((ends - offset) / gain).sort(0).values
        self.action_low, self.action_high = ends
        half = torch.where(ends.isfinite().all(0), (ends[1] - ends[0]) / 2, 1.0)
        self.action_steps = STEP * torch.cat([torch.zeros(1, len(half)), half.diag()])

    @property
    def names(self) -> tuple[list[str], list[str]]:
        """Names of the state coordinates, ``q_JOINT``, ``v_JOINT``, ``w_...``, and of actions."""
        return state_names(self.mjcf), actuator_names(self.mjcf)

    def home_at(self, pose: np.ndarray | None) -> Tensor | None:
        """Return the actions ``(A,)`` with which servos hold a pose, see :func:`home_of`."""
        held = home_of(self.mjcf, pose)
        if self.gain is None or self.offset is None:
            return held
        if self.gain.dim() == 2:
            return None
        home = ((0.0 if held is None else held) - self.offset) / self.gain
        return home if home.any() else None

    def check_range(self, low: Any, high: Any) -> None:
        """Refuse an action space that differs from the range of the actions, if no map was given.

        Raises:
            ConfigurationError: see :func:`~afm_rl.dynamics.action_map.check_range`.
        """
        if not self.mapped:
            check_range((low, high), (self.action_low, self.action_high))

    def warm_start(self, states: np.ndarray, accelerations: np.ndarray) -> None:
        """Set the initial guess of the solver to that of a simulated robot.

        A solver that stops after few iterations depends on its initial guess, so this makes the
        model exact. If the solver converges, it has no effect.

        Args:
            states: current states of the robots, ``(N, S)``, in double precision.
            accelerations: ``qacc_warmstart`` of their ``MjData``, ``(N, V)``.
        """
        simulator: Any = self.step
        simulator.warm_start(states, accelerations)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``(*B, S)``."""
        return self._simulate(state, action.unsqueeze(-2)).squeeze(-2)

    @closed_form
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states ``(*B, N, H, S)`` of plans, simulated in one call."""
        return self._simulate(state.unsqueeze(-2), actions)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return finite differences ``(*B, D, A)``."""
        steps = self.action_steps.to(action)
        after = self.forward(state.unsqueeze(-2), action.unsqueeze(-2) + steps)
        change = self.manifold.difference(after[..., 1:, :], after[..., :1, :])
        return change.mT / steps[1:].diagonal()

    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the next state and finite differences by state and action."""
        size = self.state_size
        steps = STEP * torch.eye(size).to(state)
        steps = torch.cat([state.new_zeros(self.action_size + 1, size), steps])
        act = torch.nn.functional.pad(self.action_steps.to(action), (0, 0, 0, size))
        after = self.forward(state.unsqueeze(-2) + steps, action.unsqueeze(-2) + act)
        change = (after[..., 1:, :] - after[..., :1, :]).mT
        by_action, by_state = change.split([self.action_size, size], -1)
        return after[..., 0, :], by_state / STEP, by_action / act.amax(0)

    def _simulate(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states ``(*B, H, S)`` after actions ``(*B, H, A)`` from ``(*B, S)``."""
        if self.gain is not None and self.offset is not None:
            gain, offset = self.gain.to(actions), self.offset.to(actions)
            actions = (actions @ gain.mT if gain.dim() == 2 else gain * actions) + offset
        rows, plans = _numbers(state), _numbers(actions)
        batch: tuple[int, ...] = state.shape[:-1]
        if batch != actions.shape[:-2]:
            batch = np.broadcast_shapes(batch, actions.shape[:-2])
            rows = np.broadcast_to(rows, (*batch, rows.shape[-1]))
            plans = np.broadcast_to(plans, (*batch, *plans.shape[-2:]))
        rows = rows.reshape(-1, rows.shape[-1])
        plans = plans.reshape(-1, *plans.shape[-2:])
        step: Any = self.step  # of plans, in numpy
        told, nominal, numbers = self.physics_now, self.nominal, [rows, plans]
        if told is not nominal and not torch.equal(told, nominal.to(told).expand_as(told)):
            told = self._physics_for(len(batch))
            numbers.append(_numbers(told.expand(*batch, -1).reshape(len(rows), told.shape[-1])))
        after = step(*numbers)
        return torch.from_numpy(after.reshape(*batch, *after.shape[1:])).to(state)


def _numbers(values: Tensor) -> np.ndarray:
    """Return a tensor as an array in double precision."""
    return values.numpy(force=True).astype(np.float64, copy=False)
