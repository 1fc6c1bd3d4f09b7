"""Settings of the environments, checked before anything runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_count, check_instance, check_number, refusing
from afm_rl.regimes import Regime, Schedule


def check_batch(batch_size: Sequence[int] | int) -> torch.Size:
    """Return the batch shape; a number counts as one dimension.

    >>> check_batch(4)
    torch.Size([4])
    """
    sizes = batch_size if isinstance(batch_size, Iterable) else (batch_size,)
    return torch.Size([check_count("batch_size", size) for size in sizes])


def check_dtype(dtype: torch.dtype | None) -> torch.dtype:
    """Return the floating-point type, by default torch's.

    >>> check_dtype(None)
    torch.float32
    """
    dtype = torch.get_default_dtype() if dtype is None else dtype
    if dtype not in (torch.float32, torch.float64):
        raise ConfigurationError(f"dtype={dtype!r}: expected torch.float32 or torch.float64")
    return dtype


def listed(tracks: Any) -> Iterable[Any]:
    """Return tracks as a list, also if one is given."""
    alone = isinstance(tracks, (str, Path)) or not isinstance(tracks, Iterable)
    return (tracks,) if alone else tracks


def check_names(setting: str, names: Sequence[str]) -> None:
    """Check that there are names, and that they are distinct."""
    if not names or len(set(names)) < len(names):
        raise ConfigurationError(f"{setting}={names}: expected at least one, with distinct names")


def check_regime(
    regime: Regime | None, default: Callable[[], Regime], states: int, actions: int
) -> Regime:
    """Return the regime family, or the default one; it must fit the number of actions.

    >>> from afm_rl.regimes import ActionGain
    >>> check_regime(None, lambda: ActionGain(["v_gain"]), states=3, actions=1).names
    ('v_gain',)
    """
    regime = default() if regime is None else check_instance("regime", regime, Regime)
    try:
        size = regime.apply(torch.zeros(actions), regime.encode({}), torch.zeros(states)).shape
    except RuntimeError:
        size = None
    if size != (actions,):
        raise ConfigurationError(
            f"regime with parameters {', '.join(regime.names)}: does not fit {actions} actions"
        )
    return regime


def check_bounds(
    low: Sequence[float], high: Sequence[float], actions: Sequence[str], dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest action ``(A,)``, low < high.

    >>> check_bounds([-1, -2], [1, 2], ["v (m/s)", "omega (rad/s)"], torch.float32)[1]
    tensor([1., 2.])
    """
    bounds = []
    for name, values in (("action_low", low), ("action_high", high)):
        several = isinstance(values, Sequence) and not isinstance(values, str)
        if not several or len(values) != len(actions):
            raise ConfigurationError(f"{name}={values!r}: expected numbers for {actions}")
        bounds.append([check_number(name, value) for value in values])
    if any(below >= above for below, above in zip(*bounds, strict=True)):
        raise ConfigurationError(
            f"action_low={bounds[0]}: expected less than action_high={bounds[1]} on each axis"
        )
    lowest, highest = torch.tensor(bounds).to(dtype)
    return lowest, highest


def check_missions(missions: TensorDictBase | None, batch: torch.Size) -> TensorDictBase | None:
    """Return the default missions, to be expanded to batches that end in their shape.

    >>> check_missions(None, torch.Size([4])) is None
    True
    """
    if missions is None:
        return None
    if not isinstance(missions, TensorDictBase) or "mission" not in missions.keys():
        raise ConfigurationError(
            "missions: expected a tensordict with a `mission` entry, such as env.mission(...)"
        )
    shapes = f"batch {tuple(missions.batch_size)} does not broadcast to batch_size={tuple(batch)}"
    with refusing(f"missions: {shapes}"):
        return missions.expand(batch)["mission"]


def schedule_in_seconds(times: Sequence[float], dt: float = 0.05) -> Schedule:
    """Return a schedule whose phases begin at the first time step after given times.

    Args:
        times: increasing times above 0 (s).
        dt: time step (s).

    Raises:
        ConfigurationError: for times that cannot be used.

    >>> schedule_in_seconds([2.0, 5.0]).at  # phases begin after half a step before 40 and 100
    (39.5, 99.5)
    """
    return Schedule(steps_at(times, dt), by="step")


def steps_at(times: Sequence[float], dt: float) -> list[float]:
    """Return breakpoints in steps: half a step before the first one at or after each time (s).

    >>> steps_at([0.12], dt=0.05)
    [2.5]
    """
    if isinstance(times, str) or not isinstance(times, Sequence):
        raise ConfigurationError(f"times={times!r}: expected a list of times (s)")
    given = [check_number("times", value, low=0.0, open_low=True) for value in times]
    if given != sorted(given):
        raise ConfigurationError(f"times={given}: expected increasing times (s)")
    return [math.ceil(value / dt - 1e-6) - 0.5 for value in given]
