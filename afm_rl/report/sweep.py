"""The jobs of a sweep, told apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from yaml import YAMLError, safe_load

from afm_rl.errors import ConfigurationError

ASKED = "job.yaml"
RESULTS = ("missions.csv", "study.yaml")
TOLD = {"method", "label", "compare", "study", "seeds", "tracks", "regimes"}
"""Overrides whose effect stands in the tables anyway."""


class Source(NamedTuple):
    """A folder of results."""

    folder: Path
    apart: tuple[str, ...] = ()
    """Overrides that its methods are named after."""

    def name(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return a table with the overrides behind the names in its column ``method``.

        >>> table = pd.DataFrame({"method": ["physics", "mine+budget=5"]})
        >>> Source(Path("0"), ("budget=5",)).name(table)["method"].tolist()
        ['physics+budget=5', 'mine+budget=5']
        """
        names = [self._name(method) for method in table["method"]]
        return table.assign(method=pd.Series(names, index=table.index, dtype=object))

    def _name(self, method: str) -> str:
        parts = str(method).split("+")
        return "+".join([*parts, *(text for text in self.apart if text not in parts)])


def sources(folders: Sequence[str | Path]) -> tuple[list[Source], list[str]]:
    """Return the folders of results, with each sweep's jobs in its place.

    A job's methods are named after the overrides that not all jobs of its sweep have:
    ``physics+planner.horizon=5``.

    Returns:
        The folders, and a sentence for each job that has no results.

    Raises:
        ConfigurationError: if no job of a sweep has results, or a ``job.yaml`` cannot be read.
    """
    found, notes = [], []
    for folder in map(Path, folders):
        jobs = sorted(folder.glob(f"*/{ASKED}"), key=lambda path: (len(path.parts[-2]), path))
        if not jobs or any((folder / name).is_file() for name in RESULTS):
            found.append(Source(folder))
            continue
        asked = {path.parent: _overrides(path) for path in jobs}
        common = set.intersection(*map(set, asked.values()))
        parts = []
        for job, overrides in asked.items():
            apart = [text for text in overrides if text not in common]
            if any((job / name).is_file() for name in RESULTS):
                kept = (text for text in apart if text.split("=")[0] not in TOLD)
                parts.append(Source(job, tuple(kept)))
            else:
                notes.append(f"{job} has no results: {' '.join(apart or overrides)}.")
        if not parts:
            raise ConfigurationError(f"{folder}: no job of this sweep has results yet")
        found += parts
    return found, notes


def _overrides(path: Path) -> list[str]:
    try:
        return [str(text) for text in safe_load(path.read_text())["overrides"]]
    except (YAMLError, TypeError, KeyError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: damaged; expected a list of overrides") from error
