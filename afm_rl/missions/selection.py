"""Which missions to run: tracks x regimes x seeds, as written in a configuration."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from tensordict import TensorDictBase

from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.missions.robot import Robot
from afm_rl.regimes import Compose, Schedule


@dataclass(frozen=True)
class Listed:
    """Regimes that are listed: a mission's seed says which one it meets; of one, every mission.

    Args:
        name: what they are called in configurations and tables.
        given: arguments of ``env.mission``: ``regime``, and ``at`` and ``ramp`` if there are any.

    >>> Listed("heavy", [{"regime": {"mass": 1.5}}, {"regime": {"mass": 2.0}}]).mission(seed=3)
    {'regime': {'mass': 2.0}}
    """

    name: str
    given: Sequence[Mapping[str, Any]]

    def mission(self, seed: int) -> dict[str, Any]:
        """Return the arguments of ``env.mission``."""
        return dict(self.given[seed % len(self.given)])


@dataclass(frozen=True)
class Family:
    """A family of regimes.

    What a mission meets is drawn from the family's name and the mission's seed alone: it is the
    same on every track, and for every method.

    Args:
        name: what it is called in configurations and tables.
        regime: the robot's regime, whose families are drawn.
        draw: lists of their names; each draw picks one list and draws all in it.
        fixed: parameters that are set after the draw.
        ramp: steps over which each change comes about; 0 for sudden changes.
        changes: number of changes, each to a new draw, at random progress. 0: one change, on the
            robot's schedule.
        between: progress between which these are drawn.

    Raises:
        ConfigurationError: for names and numbers that cannot be used.

    >>> from afm_rl.regimes import ActionGain
    >>> regime = Compose({"gain": ActionGain(["v_gain", "omega_gain"])})
    >>> turned = Family("turned", regime, [["gain"]], {"v_gain": -1.0})
    >>> turned.mission(seed=3)["regime"]["v_gain"]
    -1.0
    """

    name: str
    regime: Compose
    draw: Sequence[Sequence[str]] = ((),)
    fixed: Mapping[str, float] = field(default_factory=dict)
    ramp: int = 0
    changes: int = 0
    between: tuple[float, float] = (0.1, 0.9)

    def __post_init__(self) -> None:
        """Check names and numbers."""
        where, regime, rows = f"robot.families.{self.name}", self.regime, self.draw
        if not isinstance(regime, Compose):
            raise ConfigurationError(
                f"{where}: expected robot.regime to be a Compose, to draw from"
            )
        if not isinstance(rows, list | tuple) or not all(
            isinstance(row, list | tuple) for row in rows
        ):
            raise ConfigurationError(
                f"{where}.draw={rows!r}: expected names among {', '.join(regime.regimes)}, or "
                "lists of these to pick from"
            )
        for family in (family for row in rows for family in row):
            check_choice(f"{where}.draw", family, regime.regimes)
        if not isinstance(self.fixed, Mapping):
            raise ConfigurationError(
                f"{where}.set={self.fixed!r}: expected a mapping of {', '.join(regime.names)}"
            )
        regime.encode(self.fixed)
        check_count(f"{where}.changes", self.changes, low=0)
        check_count(f"{where}.ramp", self.ramp, low=0)

    def mission(self, seed: int) -> dict[str, Any]:
        """Return the arguments of ``env.mission``: ``regime``, ``at`` and ``ramp``."""
        generator = torch.Generator().manual_seed(_stable(self.name, seed))
        if not self.changes:
            return {"regime": self._values(generator), "ramp": self.ramp}
        low, high = self.between
        at = low + (high - low) * torch.rand(self.changes, generator=generator)
        phases = [{}, *(self._values(generator) for _ in range(self.changes))]
        return {"regime": phases, "at": at.sort().values.tolist(), "ramp": self.ramp}

    def _values(self, generator: torch.Generator) -> dict[str, float]:
        """Return a draw of all parameters, by name."""
        names = self.draw[int(torch.randint(len(self.draw), (), generator=generator))]
        row = self.regime.draw(names, (), generator)
        return {**dict(zip(self.regime.names, row.tolist(), strict=True)), **self.fixed}


def find_family(name: str, robot: Robot) -> Family | Listed:
    """Return a family of the robot's configuration."""
    given: Any = robot.families[check_choice("regimes", name, robot.families)]
    where, settings = f"robot.families.{name}", ("draw", "set", "ramp", "changes")
    if isinstance(given, Mapping) and "list" in given:
        return Listed(name, [{"regime": regime} for regime in given["list"]])
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{where}={given!r}: expected a mapping of {', '.join(settings)}")
    for key in given:
        check_choice(f"{where}: setting", key, settings)
    rows = given.get("draw", [])
    if isinstance(rows, list) and all(isinstance(entry, str) for entry in rows):
        rows = [rows]
    regime: Any = robot.regime
    numbers = {key: given[key] for key in ("ramp", "changes") if key in given}
    family = Family(name, regime, rows, given.get("set", {}), **numbers)
    if family.changes and robot.schedule.by != "progress":
        raise ConfigurationError(
            f"{where}.changes={family.changes}: breakpoints are drawn as progress; choose "
            "robot.schedule.by=progress"
        )
    return family


def _stable(name: str, seed: int) -> int:
    """Return a seed for (name, seed) that is the same in every process."""
    digest = hashlib.sha256(f"{name} {seed}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1  # a generator takes 63 bits


Entry = Family | Listed


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
    if isinstance(regimes, str):
        named: dict[str, list[Any]] = {name: [name] for name in robot.families}
        named |= {"none": [{}], "paper": [*robot.paper_regimes], "families": [*robot.families]}
        regimes = named.get(regimes, regimes)
    regimes = [regimes] if isinstance(regimes, Mapping) else regimes
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
        check_choice("regimes: setting", key, ("phases", "at", "ramp"))
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
) -> tuple[TensorDictBase, list[str]]:
    """Return every combination, a tensordict ``(B,)`` for ``env.reset``, and regimes in words."""
    cells = [*product(range(len(tracks)), regimes, seeds)]
    missions = [env.mission(track, seed, **entry.mission(seed)) for track, entry, seed in cells]
    return torch.stack(missions), [entry.name for _, entry, _ in cells]


def name_method(settings: Mapping[str, Any]) -> str:
    """Name a method that has no label: the preset of a Hydra application, or else its parts.

    >>> parts = {"dynamics": "factories.physics", "updater": "RLSUpdater", "corrector": "AFM"}
    >>> name_method({group: {"_target_": f"afm_rl.{name}"} for group, name in parts.items()})
    'physics+RLSUpdater+AFM'
    """
    chosen = HydraConfig.get().runtime.choices if HydraConfig.initialized() else {}
    if chosen.get("method"):
        return str(chosen["method"])
    made = [settings[group]["_target_"] for group in ("dynamics", "updater", "corrector")]
    idle = ("afm_rl.learning.Updater", "afm_rl.missions.factories.no_correction")
    return "+".join(name.rpartition(".")[2] for name in made if name not in idle)
