"""What one mission is made of, as entries of a tensordict, and its noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.regimes import Regime, Schedule
from afm_rl.streams import Streams


class MissionFormat:
    """The entries under ``"mission"``: track, noise, regime and schedule.

    ============== ======= ===========================================================
    ``track``      int64   index of the track, ``(*B)``
    ``seed``       int64   seed of the mission's noise, ``(*B)``
    ``parameters`` float   regime parameters per phase, ``(*B, P, F)``
    ``at``         float   breakpoints of the schedule, ``(*B, K)``, padded with ``inf``
    ``ramp``       int64   steps that a change takes, ``(*B)``; 0 for sudden changes
    ============== ======= ===========================================================

    The entries are part of the state, so one tensordict can hold any mix of missions.

    Args:
        tracks: names of the tracks.
        regime: the regime family, with F parameters.
        schedule: the schedule, with K breakpoints and P = K + 1 phases.
        dtype: floating-point type.

    >>> from afm_rl.regimes import ActionGain
    >>> form = MissionFormat(("a", "b"), ActionGain(["v_gain", "omega_gain"]), Schedule())
    >>> form.build("b", regime={"v_gain": -1.0})["mission", "parameters"][1]
    tensor([-1.,  1.])
    """

    def __init__(
        self,
        tracks: Sequence[str],
        regime: Regime,
        schedule: Schedule,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.tracks = tuple(tracks)
        self.regime = regime
        self.schedule = schedule
        self.dtype = dtype
        self._shapes: dict[str, tuple[int, ...]] = {
            "track": (),
            "seed": (),
            "parameters": (schedule.phases, len(regime.names)),
            "at": (len(schedule.at),),
            "ramp": (),
        }

    def spec(self, batch: torch.Size, device: torch.device | None) -> Composite:
        """Return the spec of the ``"mission"`` entry."""
        last = len(self.tracks) - 1
        leaves = {
            "track": Bounded(0, last, shape=batch, dtype=torch.int64, device=device),
            "seed": Unbounded(shape=batch, dtype=torch.int64, device=device),
            "ramp": Bounded(0, 2**31 - 1, shape=batch, dtype=torch.int64, device=device),
        }
        for name in ("parameters", "at"):
            shape = (*batch, *self._shapes[name])
            leaves[name] = Unbounded(shape=shape, dtype=self.dtype, device=device)
        return Composite(leaves, shape=batch, device=device)

    def build(
        self,
        track: int | str = 0,
        seed: int | None = None,
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        at: Sequence[float] | None = None,
        ramp: int = 0,
    ) -> TensorDict:
        """Describe one mission: ``env.reset(torch.stack([...]), set_state=False)`` runs many.

        Args:
            track: index or name.
            seed: seed of its noise; if None, the environment numbers its missions.
            regime: parameters that are not nominal: one mapping for the second phase (the
                only one, if there is no breakpoint), or one mapping per phase.
            at: breakpoints of the mission, at most as many as those of the schedule; the
                schedule's if None. The last phase continues to the end.
            ramp: steps over which the parameters move linearly from those of the last phase to
                those of the present one; 0 for sudden changes.

        Raises:
            ConfigurationError: for a value that cannot be used.
        """
        if isinstance(track, str):
            track = self.tracks.index(check_choice("missions: track", track, self.tracks))
        elif check_count("missions: track", track, low=0) >= len(self.tracks):
            raise ConfigurationError(f"missions: track={track}: there are {len(self.tracks)}")
        breakpoints = self._breakpoints(at)
        phases = len(breakpoints) + 1
        if regime is None or isinstance(regime, Mapping):
            changed = min(1, phases - 1)
            regime = [(regime or {}) if phase == changed else {} for phase in range(phases)]
        whole = isinstance(regime, Sequence) and len(regime) == phases
        if not whole or not all(isinstance(values, Mapping) for values in regime):
            raise ConfigurationError(
                f"regimes: {regime!r}: expected one mapping, or one for each of {phases} phases"
            )
        more = self.schedule.phases - phases
        rows = torch.stack([self.regime.encode(values) for values in regime])
        entries = {
            "track": torch.tensor(track),
            "parameters": torch.cat([rows, rows[-1:].expand(more, -1)]),
            "at": torch.tensor([*breakpoints, *[math.inf] * more]),
            "ramp": torch.tensor(check_count("missions: ramp", ramp, low=0)),
        }
        if seed is not None:
            entries["seed"] = torch.tensor(check_count("missions: seed", seed, low=0))
        return TensorDict({"mission": entries})

    def _breakpoints(self, at: Sequence[float] | None) -> list[float]:
        """Return a mission's own breakpoints, or the schedule's without its padding."""
        room = len(self.schedule.at)
        if at is None:
            return [value for value in self.schedule.at if math.isfinite(value)]
        if isinstance(at, str) or not isinstance(at, Sequence) or len(at) > room:
            raise ConfigurationError(
                f"missions: at={at!r}: expected a list of at most {room} breakpoints; give the "
                "environment a schedule with more phases, such as Schedule(...).padded(9)"
            )
        return list(Schedule(at, self.schedule.by).at)

    def complete(
        self, given: TensorDictBase | None, batch: torch.Size, seed: int, device
    ) -> TensorDict:
        """Check the ``given`` entries of a batch of missions and add missing ones.

        Defaults are the first track, nominal dynamics, the schedule's breakpoints, no ramp, and
        the seeds ``seed, seed + 1, ...`` so that no two missions share their noise.

        Raises:
            ConfigurationError: for an unknown entry, a wrong shape or an impossible value.
        """
        entries = {} if given is None else {key: given.get(key) for key in given.keys()}
        for name, value in entries.items():
            check_choice("missions: entry", name, self._shapes)
            if value.shape != (*batch, *self._shapes[name]):
                raise ConfigurationError(
                    f"missions: {name} {tuple(value.shape)}: expected "
                    f"{(*batch, *self._shapes[name])}"
                )
        index = torch.arange(batch.numel(), device=device).reshape(batch)
        nominal = torch.tensor(self.regime.identity).expand(self._shapes["parameters"])
        default: dict[str, Tensor] = {
            "track": torch.zeros_like(index),
            "seed": seed + index,
            "parameters": nominal.expand(*batch, *nominal.shape),
            "at": torch.tensor(self.schedule.at).expand(*batch, -1),
            "ramp": torch.zeros_like(index),
        }
        mission = {}
        for name, value in default.items():
            whole = name in ("track", "seed", "ramp")
            value = entries.get(name, value)
            mission[name] = value.to(device, torch.int64 if whole else self.dtype, copy=True)
        self._check_values(mission)
        return TensorDict(mission, batch, device=device)

    def _check_values(self, mission: Mapping[str, Tensor]) -> None:
        last = len(self.tracks) - 1
        if ((mission["track"] < 0) | (mission["track"] > last)).any():
            raise ConfigurationError(f"missions: track: expected indices 0..{last}")
        if not mission["parameters"].isfinite().all():
            raise ConfigurationError("missions: parameters: expected finite numbers")
        self.regime.check_limits(mission["parameters"])
        if (mission["ramp"] < 0).any():
            raise ConfigurationError("missions: ramp: expected whole numbers of at least 0")
        if mission["at"].isnan().any():
            raise ConfigurationError("missions: at: expected numbers; pad with inf")


class MissionNoise:
    """Start, process, sensor and actuator noise that depend on a mission's seed alone.

    Each kind draws from streams of its own, so a reset does not shift the noise of the steps, and
    rows that are left out of a call draw nothing. Rows with equal seeds share their numbers call
    by call: step them together, and they are paired.

    Args:
        kinds: by name, a salt, which separates the streams of a kind from all others, and how many
            numbers it draws, N; those of the ground robot if None.

    >>> noise = MissionNoise()
    >>> seeds = torch.tensor([3, 4, 3])
    >>> drawn = noise.normal("start", seeds, torch.tensor([True, False, True]))
    >>> bool((drawn[0] == drawn[2]).all()), drawn[1]
    (True, tensor([0., 0., 0.]))
    """

    def __init__(self, kinds: Mapping[str, tuple[int, int]] | None = None) -> None:
        if kinds is None:  # those of a ground robot
            kinds = {"start": (0x55475653, 3), "process": (0x55475650, 3)}
            kinds |= {"actuator": (0x55475641, 2)}
        self.sizes = {name: size for name, (_, size) in kinds.items()}
        self.streams = {name: Streams(salt=salt) for name, (salt, _) in kinds.items()}

    def normal(
        self,
        event: str,
        seeds: Tensor,
        rows: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:
        """Draw N(0, 1) numbers ``(*B, N)``.

        Args:
            event: a kind of noise, such as ``"start"``.
            seeds: seed of each mission, ``(*B)``.
            rows: missions that draw, booleans ``(*B)``; the others get zeros. All if None.
            dtype: floating-point type.
        """
        size, stream = (self.sizes[event],), self.streams[event]
        if rows is None:
            return stream.normal(size, seeds=seeds, device=seeds.device, dtype=dtype)
        noise = torch.zeros(*seeds.shape, *size, device=seeds.device, dtype=dtype)
        noise[rows] = stream.normal(size, seeds=seeds[rows], device=seeds.device, dtype=dtype)
        return noise

    def restart(self) -> None:
        """Let every stream begin again."""
        for stream in self.streams.values():
            stream.manual_seed(stream.seed)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Return the states of all generators, per event."""
        return {name: stream.state_dict() for name, stream in self.streams.items()}

    def load_state_dict(self, state: dict[str, dict[str, Tensor]]) -> None:
        for name, stream in self.streams.items():
            stream.load_state_dict(state[name])


def flight_noise(between: int) -> MissionNoise:
    """Return the noise of a quadrotor, with readings of its sensor ``between`` two ticks."""
    kinds = {"start": (0x464C5953, 3), "sensor": (0x464C594E, 12), "actuator": (0x464C5941, 4)}
    return MissionNoise({**kinds, "between": (0x464C5942, 12 * between)})
