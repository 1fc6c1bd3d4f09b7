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

Entry = Family | Listed
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
        regimes = [{}]
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
    return [_entry(entry, robot) for entry in regimes]


def _entry(entry: Any, robot: Robot) -> Entry:
    """Return one entry of the list."""
    if isinstance(entry, str):
        return find_family(entry, robot)
    planned = isinstance(entry, Mapping) and "phases" in entry
    given = dict(entry) if planned else {"phases": entry}
    for key in given:
        check_choice("regimes: setting", key, PLAN)
    for key in ("phases", "at") if planned else ():
        if not isinstance(given.get(key, []), list):
            raise ConfigurationError(f"regimes: {key}={given[key]!r}: expected a list")
    check_count("regimes: ramp", given.get("ramp", 0), low=0)
    regime = given.pop("phases")
    words = []
    for phase in regime if isinstance(regime, list) else [regime]:
        if not isinstance(phase, Mapping):
            raise ConfigurationError(
                f"regimes: {phase!r}: expected a mapping of {', '.join(robot.regime.names)}"
            )
        words.append(robot.regime.describe(robot.regime.encode(phase)))
    if given.get("at"):
        words.append("at " + ", ".join(f"{value:g}" for value in given["at"]))
    if given.get("ramp"):
        words.append(f"ramp {given['ramp']}")
    return Listed("; ".join(words), [{"regime": regime, **given}])


def select_seeds(seeds: Any) -> list[int]:
    """Return seeds: a count, or a list."""
    if isinstance(seeds, int) and not isinstance(seeds, bool) and 1 <= seeds <= 100_000:
        return list(range(seeds))
    whole = isinstance(seeds, list) and all(type(s) is int and 0 <= s < 2**63 for s in seeds)
    if not whole or not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(
            f"seeds={seeds!r}: expected a count in 1..100000, or a list of distinct whole numbers"
        )
    return seeds


def fit_schedule(schedule: Schedule, regimes: Sequence[Entry]) -> Schedule:
    """Return the schedule with room for the phases of every regime."""
    own = [len(entry.mission(seed=0).get("at") or ()) + 1 for entry in regimes]
    return schedule.padded(max(own))


def build_missions(
    env: Any, tracks: Sequence[str], regimes: Sequence[Entry], seeds: Sequence[int]
) -> TensorDictBase:
    """Return every combination as one tensordict ``(B,)`` for ``env.reset``."""
    cells = product(range(len(tracks)), regimes, seeds)
    return torch.stack(
        [env.mission(track, seed, **one.mission(seed)) for track, one, seed in cells]
    )


def name_regimes(
    tracks: Sequence[str], regimes: Sequence[Entry], seeds: Sequence[int]
) -> list[str]:
    """Return the regime of every combination in words, in the order of :func:`build_missions`."""
    return [entry.name for _, entry, _ in product(tracks, regimes, seeds)]
