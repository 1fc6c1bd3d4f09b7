"""Settings of the ground robot environment, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.track import Track
from afm_rl.envs.tracks import load_track
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.regimes import ActionGain, Regime, Schedule


def load_tracks(tracks: Sequence[str | Path | Track] | str | Path | Track) -> tuple[Track, ...]:
    """Return the tracks of a setting: names, files or tracks, one or several.

    Raises:
        ConfigurationError: if there is none, one cannot be used, or two share a name.

    >>> [track.name for track in load_tracks(["ethz_1", "ethz_2"])]
    ['ethz_1', 'ethz_2']
    """
    if isinstance(tracks, (str, Path)) or not isinstance(tracks, Iterable):
        tracks = (tracks,)
    loaded = tuple(one if isinstance(one, Track) else load_track(one) for one in tracks)
    names = [track.name for track in loaded]
    if not names or len(set(names)) < len(names):
        raise ConfigurationError(f"tracks={names}: expected at least one, with distinct names")
    return loaded


def action_box(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Return the bounds ``(2,)`` of v (m/s) and omega (rad/s).

    Raises:
        ConfigurationError: unless both name two finite numbers, the lower below the upper.

    >>> action_box([-1, -2], [1, 2])[1]
    tensor([1., 2.], dtype=torch.float64)
    """
    bounds = []
    for name, values in (("action_low", low), ("action_high", high)):
        if not isinstance(values, Iterable) or len(values) != 2:
            raise ConfigurationError(f"{name}={values!r}: expected two numbers, v and omega")
        bounds.append([check_number(name, value) for value in values])
    if any(below >= above for below, above in zip(*bounds, strict=True)):
        raise ConfigurationError(
            f"action_low={bounds[0]}: expected less than action_high={bounds[1]} on each axis"
        )
    return torch.tensor(bounds[0]).double(), torch.tensor(bounds[1]).double()


def check_regime(regime: Regime | None) -> Regime:
    """Return the regime family, by default gains on v and omega.

    Raises:
        ConfigurationError: if it is no family, or does not fit actions of two components.

    >>> check_regime(None).names
    ('v_gain', 'omega_gain')
    """
    if regime is None:
        return ActionGain(["v_gain", "omega_gain"])
    if not isinstance(regime, Regime):
        raise ConfigurationError(f"regime={regime!r}: expected a Regime")
    try:
        size = regime.apply(torch.zeros(2), regime.encode({}), torch.zeros(3)).shape
    except RuntimeError:
        size = None
    if size != (2,):
        raise ConfigurationError(
            f"regime with parameters {', '.join(regime.names)}: does not fit actions (v, omega)"
        )
    return regime


def check_schedule(schedule: Schedule | None) -> Schedule:
    """Return the schedule, by default the paper's: 0.15 and 0.80 of the targets.

    Raises:
        ConfigurationError: if it is no schedule.

    >>> check_schedule(None).at
    (0.15, 0.8)
    """
    if schedule is None:
        return Schedule()
    if not isinstance(schedule, Schedule):
        raise ConfigurationError(f"schedule={schedule!r}: expected a Schedule")
    return schedule


def check_missions(missions: TensorDictBase | None, batch: torch.Size) -> TensorDictBase | None:
    """Return the default missions, to be expanded to batches that end in their shape.

    Raises:
        ConfigurationError: if there is no ``mission`` entry, or it does not broadcast.

    >>> check_missions(None, torch.Size([4])) is None
    True
    """
    if missions is None:
        return None
    if not isinstance(missions, TensorDictBase) or "mission" not in missions.keys():
        raise ConfigurationError(
            "missions: expected a tensordict with a `mission` entry, such as env.mission(...)"
        )
    try:
        return missions.expand(batch)["mission"]
    except RuntimeError as error:
        raise ConfigurationError(
            f"missions: batch {tuple(missions.batch_size)} does not broadcast to batch_size="
            f"{tuple(batch)}"
        ) from error


def check_batch(batch_size: Sequence[int] | int) -> torch.Size:
    """Return the batch shape; a number counts as one dimension.

    Raises:
        ConfigurationError: unless every size is a whole number of at least 1.

    >>> check_batch(4)
    torch.Size([4])
    """
    sizes = batch_size if isinstance(batch_size, Iterable) else (batch_size,)
    return torch.Size([check_count("batch_size", size) for size in sizes])


def check_dtype(dtype: torch.dtype | None) -> torch.dtype:
    """Return the floating-point type, by default torch's.

    Raises:
        ConfigurationError: if it is not torch.float32 or torch.float64.

    >>> check_dtype(None)
    torch.float32
    """
    dtype = torch.get_default_dtype() if dtype is None else dtype
    if dtype not in (torch.float32, torch.float64):
        raise ConfigurationError(f"dtype={dtype!r}: expected torch.float32 or torch.float64")
    return dtype
