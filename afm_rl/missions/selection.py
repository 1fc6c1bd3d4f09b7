"""Which missions to run: tracks x regimes x seeds, as written in a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import torch
from tensordict import TensorDictBase

from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.missions.families import Family, Listed, find_family
from afm_rl.missions.robot import Robot
from afm_rl.regimes import Schedule

Entry = Family | Listed | Mapping[str, Any] | Sequence[Mapping[str, float]]
MOST_SEEDS = 100_000
PLAN = ("phases", "at", "ramp")


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


def select_regimes(regimes: Any, robot: Robot) -> list[Entry]:
    """Return regimes: ``paper``, ``none``, ``families``, one family's name, or a list.

    A list mixes names of families with mappings of parameters for the changed phase, lists of
    these, one per phase, and ``{phases: [...], at: [...], ramp: ...}`` with breakpoints of their
    own, which may be left out, and the steps over which a change comes about.

    Raises:
        ConfigurationError: naming the parameter that is unknown or cannot have its value.
    """
    if regimes == "none":
        return [{}]
    if regimes == "paper":
        regimes = list(robot.paper_regimes)
    if regimes == "families":
        regimes = list(robot.families)
    if isinstance(regimes, Mapping) or (isinstance(regimes, str) and regimes in robot.families):
        regimes = [regimes]
    if not isinstance(regimes, list) or not regimes:
        example = f"{{{robot.regime.names[-1]}: ...}}"
        raise ConfigurationError(
            f"regimes={regimes!r}: expected paper, none, families, one of "
            f"{', '.join(robot.families) or 'no families'}, or a list of families and of mappings "
            f"such as {example} with parameters {', '.join(robot.regime.names)}"
        )
    return [_checked(entry, robot) for entry in regimes]


def _checked(entry: Any, robot: Robot) -> Entry:
    """Return one entry of the list, with a family in place of its name."""
    if isinstance(entry, str):
        return find_family(entry, robot)
    planned = isinstance(entry, Mapping) and "phases" in entry
    if planned:
        for key in entry:
            check_choice("regimes: setting", key, PLAN)
        for key in ("phases", "at"):
            if not isinstance(entry.get(key, []), list):
                raise ConfigurationError(f"regimes: {key}={entry[key]!r}: expected a list")
        check_count("regimes: ramp", entry.get("ramp", 0), low=0)
    phases = entry["phases"] if planned else entry
    for phase in phases if isinstance(phases, list) else [phases]:
        if not isinstance(phase, Mapping):
            raise ConfigurationError(
                f"regimes: {phase!r}: expected a mapping of {', '.join(robot.regime.names)}"
            )
        robot.regime.encode(phase)
    return entry


def select_seeds(seeds: Any) -> list[int]:
    """Return seeds: a count, or a list."""
    if isinstance(seeds, int) and not isinstance(seeds, bool) and 1 <= seeds <= MOST_SEEDS:
        return list(range(seeds))
    whole = isinstance(seeds, list) and all(type(s) is int and 0 <= s < 2**63 for s in seeds)
    if not whole or not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(
            f"seeds={seeds!r}: expected a count in 1..{MOST_SEEDS}, or a list of distinct whole "
            "numbers"
        )
    return seeds


def fit_schedule(schedule: Schedule, regimes: Sequence[Entry]) -> Schedule:
    """Return the schedule with room for the phases of every regime."""
    own = [len(_arguments(entry, seed=0).get("at") or ()) + 1 for entry in regimes]
    return schedule.padded(max(own))


def build_missions(
    env: Any, tracks: Sequence[str], regimes: Sequence[Entry], seeds: Sequence[int]
) -> TensorDictBase:
    """Return every combination as one tensordict ``(B,)`` for ``env.reset``."""
    cells = product(range(len(tracks)), regimes, seeds)
    return torch.stack(
        [env.mission(track, seed, **_arguments(entry, seed)) for track, entry, seed in cells]
    )


def name_regimes(
    tracks: Sequence[str], regimes: Sequence[Entry], seeds: Sequence[int], robot: Robot
) -> list[str]:
    """Return the regime of every combination in words, in the order of :func:`build_missions`."""
    names = [_name(entry, robot) for entry in regimes]
    return [name for _, name, _ in product(tracks, names, seeds)]


def _arguments(entry: Entry, seed: int) -> dict[str, Any]:
    """Return what ``env.mission`` is told of a regime."""
    if isinstance(entry, Family | Listed):
        return entry.mission(seed)
    if isinstance(entry, Mapping) and "phases" in entry:
        return {"regime": entry["phases"], **{key: entry[key] for key in PLAN[1:] if key in entry}}
    return {"regime": entry}


def _name(entry: Entry, robot: Robot) -> str:
    if isinstance(entry, Family | Listed):
        return entry.name
    told = _arguments(entry, seed=0)
    phases = told["regime"] if isinstance(told["regime"], list) else [told["regime"]]
    words = [robot.regime.describe(robot.regime.encode(phase)) for phase in phases]
    if told.get("at"):
        words.append("at " + ", ".join(f"{value:g}" for value in told["at"]))
    if told.get("ramp"):
        words.append(f"ramp {told['ramp']}")
    return "; ".join(words)
