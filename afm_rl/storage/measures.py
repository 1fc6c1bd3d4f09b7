"""The measures by which methods are compared, as scores declare them and runs store them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from afm_rl.errors import ArtefactError, refusing

FILE = "measures.json"


def number(value: float, digits: int = 0) -> str:
    """Return a number as text; a dash if there is none.

    >>> number(0.1234, 2), number(math.nan), number(math.inf)
    ('0.12', '-', '∞')
    """
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.{digits}f}"


@dataclass(frozen=True)
class Measure:
    """A column of the table of missions by which methods are compared.

    Args:
        column: its name in the table.
        name: short name, for heads of tables.
        title: name in words, for axes of figures.
        unit: its unit; empty if it has none.
        better: ``"higher"`` or ``"lower"``.
        scale: what the column is multiplied by to get the unit.
        digits: digits after the point.
        limits: lowest and highest value that the column can have, if both are known.
        headline: shown where there is room for little, such as tables of scenarios.
        budget: what a mission spends, counted from 0: a mission that did not finish counts as the
            most that any unfinished mission of its scenario spent, and methods are compared by
            ratios.
    """

    column: str
    name: str
    title: str
    unit: str = ""
    better: str = "higher"
    scale: float = 1.0
    digits: int = 0
    limits: tuple[float, float] | None = None
    headline: bool = False
    budget: bool = False

    def __post_init__(self) -> None:
        """Check types, since declarations are also read from files.

        Raises:
            ArtefactError: for a value of the wrong kind.
        """
        texts = (self.column, self.name, self.title, self.unit)
        numbers = (self.scale, self.digits, *(self.limits or (0.0, 1.0)))
        fits = (
            all(isinstance(text, str) and len(text) <= 80 for text in texts)
            and bool(self.column)
            and all(type(x) in (int, float) and math.isfinite(x) for x in numbers)
            and isinstance(self.digits, int)
            and 0 <= self.digits <= 12
            and len(self.limits or (0, 1)) == 2
            and isinstance(self.headline, bool)
            and isinstance(self.budget, bool)
        )
        if not fits or self.better not in ("higher", "lower"):
            raise ArtefactError(
                f"measure {self.column!r}: expected short texts, finite numbers, better=higher or "
                "lower, 0 to 12 digits"
            )

    @property
    def head(self) -> str:
        """Head of a column.

        >>> Measure("mse", "MSE", "mean squared error", "m²", "lower").head
        'MSE (m²)'
        """
        return f"{self.name} ({self.unit})" if self.unit else self.name

    @property
    def label(self) -> str:
        """Label of an axis."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    @property
    def sign(self) -> int:
        """1 if more is better, -1 if less is."""
        return 1 if self.better == "higher" else -1

    def text(self, value: float, digits: int | None = None) -> str:
        """Return a value of the column as text, in the unit; a dash if there is none.

        >>> share = Measure("success_rate", "success", "targets reached", "%", scale=100, digits=1)
        >>> share.text(0.5)
        '50.0'
        """
        return number(self.scale * value, self.digits if digits is None else digits)


@dataclass(frozen=True)
class Measures:
    """All that reports know of a kind of mission.

    Args:
        each: what methods are compared by, the most important one first.
        progress: a column of the steps, and a column of the missions with the number that it can
            reach, if missions make progress that can be counted.
        error_unit: unit of the model's one-step error.

    >>> share = Measure("share", "share", "share", better="higher", headline=True)
    >>> Measures.from_json(Measures((share,)).to_json()).headlines == (share,)
    True
    """

    each: tuple[Measure, ...]
    progress: tuple[str, str] | None = None
    error_unit: str = ""

    def __iter__(self) -> Iterator[Measure]:
        return iter(self.each)

    @property
    def headlines(self) -> tuple[Measure, ...]:
        """Those that are shown where there is room for little; the first one if none says so."""
        return tuple(measure for measure in self.each if measure.headline) or self.each[:1]

    @property
    def budget(self) -> Measure | None:
        """What missions spend, if they are compared by it."""
        return next((measure for measure in self.each if measure.budget), None)

    @property
    def columns(self) -> list[str]:
        """Columns that the table of missions must have."""
        return [measure.column for measure in self.each] + [*(self.progress or ())[1:]]

    def to_json(self) -> str:
        """Return the declaration as text."""
        return json.dumps(asdict(self), ensure_ascii=False, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Measures:
        """Return what :meth:`to_json` wrote.

        Raises:
            ArtefactError: if the text is something else.
        """
        with refusing("no declaration of measures", ArtefactError):
            found = json.loads(text)
            each = tuple(_measure(entries) for entries in found["each"])
            progress, unit = found["progress"], found["error_unit"]
            names = (unit, *(progress or ()))
            whole = set(found) == {"each", "progress", "error_unit"}
            pairs = progress is None or len(progress) == 2
            if not (whole and each and pairs and all(isinstance(name, str) for name in names)):
                raise ValueError("entries are missing or of the wrong kind")
        return cls(each, None if progress is None else (progress[0], progress[1]), unit)


def _measure(entries: dict[str, Any]) -> Measure:
    limits = entries.get("limits")
    return Measure(**{**entries, "limits": None if limits is None else tuple(limits)})
