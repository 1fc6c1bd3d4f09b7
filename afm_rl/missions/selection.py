"""Which missions to run: tracks x regimes x seeds, as written in a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import torch
from tensordict import TensorDictBase

from afm_rl.errors import ConfigurationError
from afm_rl.missions.robot import Robot

RegimeValues = Mapping[str, float] | Sequence[Mapping[str, float]]


def select_tracks(tracks: Any, robot: Robot) -> list[str]:
    """Return track names: ``all``, one name or CSV path, or a list of them."""
    if tracks == "all":
        return list(robot.tracks)
    chosen = [tracks] if isinstance(tracks, str) else tracks
    if not isinstance(chosen, list) or not chosen or not all(isinstance(t, str) for t in chosen):
        raise ConfigurationError(
            f"tracks={tracks!r}: expected all, one of {', '.join(robot.tracks)}, a CSV file, or "
            "a list of these"
        )
    return chosen


def select_regimes(regimes: Any, robot: Robot) -> list[RegimeValues]:
    """Return regimes: ``paper``, ``none``, or a list; names and values are checked.

    Raises:
        ConfigurationError: naming the parameter that is unknown or not finite.
    """
    if regimes == "none":
        return [{}]
    if regimes == "paper":
        regimes = list(robot.paper_regimes)
    if isinstance(regimes, Mapping):
        regimes = [regimes]
    if not isinstance(regimes, list) or not regimes:
        raise ConfigurationError(
            f"regimes={regimes!r}: expected paper, none, or a list of mappings such as "
            f"[{{{robot.regime.names[0]}: -1.0}}] with parameters {', '.join(robot.regime.names)}"
        )
    for entry in regimes:
        for phase in entry if isinstance(entry, list) else [entry]:
            if not isinstance(phase, Mapping):
                raise ConfigurationError(
                    f"regimes: {phase!r}: expected a mapping of {', '.join(robot.regime.names)}"
                )
            robot.regime.encode(phase)
    return regimes


def select_seeds(seeds: Any) -> list[int]:
    """Return seeds: a count, or a list."""
    if isinstance(seeds, int) and not isinstance(seeds, bool) and seeds >= 1:
        return list(range(seeds))
    whole = isinstance(seeds, list) and all(type(s) is int and 0 <= s < 2**63 for s in seeds)
    if not whole or not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(
            f"seeds={seeds!r}: expected a count of at least 1, or a list of distinct whole numbers"
        )
    return seeds


def build_missions(
    env: Any, tracks: Sequence[str], regimes: Sequence[RegimeValues], seeds: Sequence[int]
) -> TensorDictBase:
    """Return every combination as one tensordict ``(B,)`` for ``env.reset``."""
    cells = product(range(len(tracks)), regimes, seeds)
    return torch.stack([env.mission(track, seed, regime) for track, regime, seed in cells])
