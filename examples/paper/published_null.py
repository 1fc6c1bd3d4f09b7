"""The paper's claims with its learner without AFM, Online PE, in place of AFM.

    python examples/paper/published_null.py benchmarks/results/ugv_paper.json

Reads the tables that ``published_tables.py`` printed: the effects of AFM with their intervals, and
the means of each scenario, from which the effects of Online PE (the *null*) are computed. These
means are printed with two digits, and have no intervals.
"""

import argparse
import json
import re
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from published_claims import (
    ABLATIONS,
    AFM,
    CLAIMS,
    LAST,
    OVER_ONLINE,
    OVER_PHYSICS,
    TITLE,
    Claim,
    estimated,
    samples_of,
)
from published_tables import FORMS, HEADS, published

from afm_rl.report.tables import markdown

NULL = "null"
CELLS = "The paper's tables of "
OURS = re.compile(r"([\d.]+)/(\d+)")
EFFECT = re.compile(
    r"(?P<shown>(?P<effect>[-+][\d.]+)(?: \[(?P<low>[-+][\d.]+), .*\])?): (?P<said>.*)"
)


class Effect(NamedTuple):
    """An effect of AFM, as printed."""

    shown: str
    low: float
    """Lower end of its interval, or the effect itself."""
    said: str


def rows_of(table: list[str]) -> list[dict[str, str]]:
    """Return the rows of a Markdown table, by the heads of its columns.

    >>> rows_of(["| a | b |", "|---|---|", "| 1 | 2 |"])
    [{'a': '1', 'b': '2'}]
    """
    heads, _, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    return [dict(zip(heads, row, strict=True)) for row in rows]


def means_of(tables: dict[str, list[str]]) -> pd.DataFrame:
    """Return our printed mean of each method and scenario."""
    names = {head: name for name, head in HEADS.items()}
    found = []
    for title, table in tables.items():
        if not title.startswith(CELLS):
            continue
        track = title.removeprefix(CELLS).partition(":")[0]
        for row in rows_of(table):
            scenario = f"{track}: {row.pop('regime')}"
            for head, cell in row.items():
                method = names[head.removesuffix(" (published)")]
                if ours := OURS.match(cell):
                    success, steps = map(float, ours.groups())
                    found.append((method, scenario, success, steps))
    return pd.DataFrame(found, columns=["method", "scenario", "success", "steps"])


def effect_of_null(claim: Claim, means: pd.DataFrame) -> float | None:
    """Return the effect of a claim with Online PE in AFM's place; None if that was not run.

    Args:
        means: one row per method and scenario.
    """
    if claim.methods == OVER_ONLINE:
        return 0.0  # Online PE beside itself
    if claim.methods not in (OVER_PHYSICS, ABLATIONS):
        return None
    learner = means[means["method"] == "online_pe"].assign(method=NULL)
    both = pd.concat([means, learner]).assign(seed=0, late=lambda table: table["steps"] >= LAST)
    methods = [NULL if name == AFM else name for name in claim.methods]
    return estimated(claim, samples_of(both, methods))["effect"]


def effect_of(cell: str) -> Effect | None:
    """Return an effect from its cell; None if it was not measured.

    >>> effect_of("+4 [-4, +9]: undecided").low
    -4.0
    """
    if cell == "-":
        return None
    found = EFFECT.fullmatch(cell)
    if found is None:
        raise SystemExit(
            f"{cell!r}: expected an effect and its verdict, such as '+4 [+1, +9]: holds'"
        )
    return Effect(found["shown"], float(found["low"] or found["effect"]), found["said"])


def verdict(size: float, effect: Effect | None, null: float | None) -> str:
    """Return whether a claim of some size (0: of its direction) holds, and whether AFM is why.

    It holds also without AFM if the null reaches the claimed size or the interval of AFM.

    >>> verdict(34.2, Effect("+36.2 [+35.8, +36.6]", 35.8, "holds"), 35.6)
    'holds, but also without AFM'
    """
    if effect is None:
        return "-"
    if not effect.said.startswith("holds"):
        return "does not hold"
    if null is None:
        return "holds"
    without = null >= effect.low or (size > 0 and null >= size)
    return "holds, but also without AFM" if without else "holds and is due to AFM"


def table_of(tables: dict[str, list[str]]) -> pd.DataFrame:
    """Return each claim as printed, as measured, and with Online PE in AFM's place."""
    printed = published().rename(columns={"success_mean": "success", "steps_mean": "steps"})
    means, claims, rows = means_of(tables), {claim.words: claim for claim in CLAIMS}, []
    for row in rows_of(tables[TITLE]):
        claim = claims[row["claim"]]
        theirs, ours = effect_of_null(claim, printed), effect_of_null(claim, means)
        effects = {form: effect_of(row[form]) for form in FORMS.values()}
        said = {form: verdict(claim.size, effect, ours) for form, effect in effects.items()}
        rows.append(
            {
                **{head: row[head] for head in ("claim", "the text", "its tables")},
                "its Online PE": _text(theirs, claim.digits),
                **{form: effect.shown if effect else "-" for form, effect in effects.items()},
                "our Online PE": _text(ours, claim.digits),
                "verdict": _agreed(said),
            }
        )
    return pd.DataFrame(rows)


def _agreed(said: dict[str, str]) -> str:
    """Return the verdict of all forms, or that of each if they differ."""
    if len(set(said.values())) == 1:
        return next(iter(said.values()))
    return "; ".join(f"{form}: {words}" for form, words in said.items())


def _text(effect: float | None, digits: int) -> str:
    return "-" if effect is None else f"{effect:+.{digits}f}" if effect else "0"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("result", type=Path, help="JSON file of a result with the paper's tables")
    options = parser.parse_args()
    tables = json.loads(options.result.read_text(encoding="utf-8"))["tables"]
    print(markdown("Claims beside Online PE", table_of(tables)))
