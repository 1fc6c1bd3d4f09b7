"""What a reader gives, and which of its names are commands and which are responses."""

from __future__ import annotations

import difflib
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from afm_rl.errors import ConfigurationError, printable

Pairs = tuple[list[str], list[str]]
"""Names of the first and of the second group."""

ACTIONS = ("action", "actions")  # LeRobot's words, and older ones
STATES = ("observation.state", "state", "states", "observation.states")
EFFECTIVE = ("effective_action", "effective")
"""Responses that were computed: actions that have the measured effects, by new and old name."""
WIDEST = 1_000
"""Most numbers of a list in a table, or of a message, that have names."""
NAMES = 100_000
"""Most names in a log."""
MEASURED = re.compile(r"(.+)\.(?:position|velocity|effort)\b.*")
"""What a message of joint states measures: none of it is a command."""
POINTER = b"version https://git-lfs"


@dataclass(frozen=True)
class Source:
    """What a file or folder holds.

    Args:
        path: of the file or folder.
        names: of all numbers that were logged, such as ``/cmd_vel.linear.x``.
        read: returns, for some of the names, their values, NaN where one is missing: of a table by
            the number of the row, of messages by their ascending times (s).
        frame: time between command and response of a healthy robot (s).
        time: name of the time (s) among the names, or None.
        episode: name of the number of the episode among the names, or None.
        topics: of messages, how many there are of each topic; names begin with the topic.
        rows: of a table of which some rows are read, how many it has; else 0.
        notes: what a reader must know.
        computed: names of what can be computed from what was logged.

    Raises:
        ConfigurationError: for too many names, or two that are the same.
    """

    path: Path
    names: Sequence[str]
    read: Callable[[Sequence[str]], Mapping[str, pd.Series]]
    frame: float = 0.0
    time: str | None = None
    episode: str | None = None
    topics: Mapping[str, int] | None = None
    rows: int = 0
    notes: tuple[str, ...] = ()
    computed: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_names(self.names)

    def listing(self) -> list[str]:
        """Return what there is: a line for each topic, or for each column.

        >>> names = ["/arm.pos[0]", "/arm.pos[1]", "/arm.mode"]
        >>> Source(Path("log.mcap"), names, lambda wanted: {}, topics={"/arm": 5}).listing()
        ['/arm (5 messages): pos[0..1], mode']
        """
        if self.topics is None:
            return [printable(name) for name in (*self.names, *self.computed)]
        lines, names = [], [*self.names, *self.computed]
        for topic, count in sorted(self.topics.items()):
            own = [name[len(topic) + 1 :] for name in names if name.startswith(f"{topic}.")]
            fields = Counter(re.sub(r"\[\d+\]$", "[]", name) for name in own)
            shown = ", ".join(f.replace("[]", f"[0..{n - 1}]") for f, n in fields.items())
            shown = shown or "no numbers that can be read"
            lines.append(printable(f"{topic} ({count} messages): {shown}", 2000))
        return [*lines, *self.notes]


@dataclass(frozen=True)
class Columns:
    """Commands and responses, as arrays.

    Args:
        names: of the commands, and of the responses.
        first: commands or actions, ``(N, A)``.
        second: responses or states, ``(N, S)``.
        t: times (s), ``(N,)``.
        episode: numbers of episodes, ``(N,)``.
        stretch: numbers of the stretches between two pauses, ``(N,)``.
        row: numbers of the rows in the file, ``(N,)``.
        read_from: rows of the file.
        frame: time between command and response of a healthy robot (s).
        notes: what a reader must know.
        effort: how hard the motors were driven, ``(M,)`` each.
        computed: were responses computed, and not measured?
        doubts: why nothing can be said of some actuators, by name.
    """

    names: tuple[Sequence[str], Sequence[str]]
    first: np.ndarray
    second: np.ndarray
    t: np.ndarray
    episode: np.ndarray
    stretch: np.ndarray
    row: np.ndarray
    read_from: int
    frame: float = 0.0
    notes: tuple[str, ...] = ()
    effort: Mapping[str, np.ndarray] = field(default_factory=dict)
    computed: bool = False
    doubts: Mapping[str, str] = field(default_factory=dict)

    def part(self, rows: np.ndarray) -> Columns:
        """Return some rows."""
        arrays = ("first", "second", "t", "episode", "stretch", "row")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})


class Unchosen(ConfigurationError):
    """It is not known what is a command and what a response; has a listing of what there is."""

    def __init__(self, message: str, source: Source) -> None:
        super().__init__(message)
        self.listing = source.listing()


class Pointer(ConfigurationError):
    """A text of Git LFS stands in the place of a file."""


def check_regular(path: Path) -> Path:
    """Return a path if it leads to a file that ends, and not to a pointer of Git LFS."""
    try:
        kind = path.stat().st_mode
        begin = b""
        if stat.S_ISREG(kind):
            with path.open("rb") as file:
                begin = file.read(len(POINTER))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(
            f"{printable(str(path), 1000)}: {reason}; expected a log, see --help"
        ) from error
    if not stat.S_ISREG(kind):
        raise ConfigurationError(
            f"{printable(str(path), 1000)}: no regular file, but a device, a pipe or a folder; "
            "expected a file"
        )
    if begin == POINTER:
        raise Pointer(
            f"{printable(str(path), 1000)}: a Git LFS pointer instead of the file; run "
            "git lfs pull in its repository"
        )
    return path


def check_names(names: Sequence[str]) -> Sequence[str]:
    """Return names if they are not too many, and no two are the same.

    >>> check_names(["t", "pan", "t"])
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: t: two columns of this name; rename one
    """
    if len(names) > NAMES:
        raise ConfigurationError(
            f"more than {NAMES:,} columns or fields: expected fewer; log or keep fewer"
        )
    name, count = next(iter(Counter(names).most_common(1)), ("", 0))
    if count > 1:
        raise ConfigurationError(f"{printable(name)}: two columns of this name; rename one")
    return names


def blocks_of(
    rows: int, width: int = 1, most: int = 400_000, count: int = 8
) -> list[tuple[int, int]]:
    """Return first and last row (exclusive) of what is read of a log.

    All rows, or blocks that are evenly spread: a block is long enough for every delay, and changes
    on the way are seen. 400,000 rows of forty numbers take 128 MB; of rows with a larger ``width``
    fewer are read.

    >>> blocks_of(100), blocks_of(1000, most=100, count=2), blocks_of(1000, 40, 100, 2)[0]
    ([(0, 100)], [(0, 50), (950, 1000)], (0, 50))
    """
    most = min(most, 40 * 400_000 // max(width, 1))
    if rows <= most:
        return [(0, rows)]
    length = most // count
    return [(int(a), int(a) + length) for a in np.linspace(0, rows - length, count)]


def rows_of(blocks: Iterable[tuple[int, int]]) -> np.ndarray:
    """Return the numbers of all rows of blocks.

    >>> rows_of([(0, 2), (7, 9)])
    array([0, 1, 7, 8])
    """
    return np.concatenate([np.arange(first, last) for first, last in blocks])


def thinned_note(row: np.ndarray, rows: int) -> tuple[str, ...]:
    """Return what must be said where not all ``rows`` were read, but those of numbers ``(N,)``.

    >>> thinned_note(np.r_[0:50, 900:950], 1000)
    ('1,000 rows are many: 2 blocks of 50 were read',)
    """
    if len(row) >= rows:
        return ()
    blocks = 1 + int((np.diff(row) != 1).sum())
    return (f"{rows:,} rows are many: {blocks} blocks of {len(row) // blocks:,} were read",)


def choose(
    source: Source,
    kinds: tuple[str, str],
    command: Sequence[str],
    response: Sequence[str],
    paired: bool,
) -> tuple[Pairs, Pairs, tuple[str, ...]]:
    """Return which names to read, what they are called, and notes.

    Args:
        source: what there is.
        kinds: ``command`` and ``response``: names that begin with these are taken.
        command: names that the user gave, ``FIELD`` or ``NAME=FIELD``; a topic or an array stands
            for all its fields.
        response: the same, one for each command.
        paired: each command has a response.
    """
    if command or response:
        if not (command and response):
            raise ConfigurationError("expected both --command and --response, or none of them")
        (read_first, first), (read_second, second) = (
            _expanded(source, option, given)
            for option, given in (("--command", command), ("--response", response))
        )
        if paired and len(first) != len(second):
            raise ConfigurationError(
                f"{len(first)} commands ({_some(first)}), but {len(second)} responses "
                f"({_some(second)}): expected a response for each command, in the same order"
            )
        return (read_first, read_second), (first, first if paired else second), ()
    # What a correction recorded has names of its own.
    commands = (kinds[0], "executed_action") if kinds[0] == "command" else kinds[:1]
    answers = (kinds[1], *EFFECTIVE) if paired else kinds[1:]
    for heads in ((commands, answers), (ACTIONS, STATES)):
        group, partner = (_under(source, names) for names in heads)
        if group and partner:
            break
    else:
        if source.topics is not None:
            raise Unchosen(
                f"{len(source.names)} fields of {len(source.topics)} topics: name commands and "
                "responses, with --command TOPIC.FIELD --response TOPIC.FIELD",
                source,
            )
        expected = f"{kinds[0]}.NAME and {kinds[1]}.NAME; rename them, or"
        if source.frame:  # a data set of LeRobot's
            expected = f"{ACTIONS[0]} and {STATES[0]};"
        raise Unchosen(
            f"columns {_some(source.names) or 'none'}: expected {expected} name the "
            "columns with --command and --response",
            source,
        )
    first, fields = list(group), list(group.values())
    if not paired:
        return (fields, list(partner.values())), (first, list(partner)), ()
    alone = sorted({*group} ^ {*partner})
    if not {*group} <= {*partner}:
        raise Unchosen(
            f"{_some(alone)}: expected a command and a response of each actuator, under the same "
            "name; or name them in pairs, with --command and --response",
            source,
        )
    notes = (f"responses without a command were left out: {_some(alone)}",) if alone else ()
    return (fields, [partner[name] for name in first]), (first, first), notes


def _under(source: Source, heads: Sequence[str]) -> dict[str, str]:
    """Return the fields under the first of some heads that there is, by their names there."""
    for head in heads:
        fields = [name for name in source.names if name.startswith(f"{head}.")]
        if fields:
            return {name[len(head) + 1 :]: name for name in fields}
    return {}


def _expanded(source: Source, option: str, given: Sequence[str]) -> Pairs:
    """Return the fields that were given, and what to call them."""
    fields: list[str] = []
    called: list[str | None] = []
    single = {*source.names, *source.computed}
    for text in given:
        own, _, field = text.rpartition("=")
        if text in single:
            own, field = "", text
        matching = [field] if field in single else []
        matching = matching or [n for n in source.names if n.startswith((f"{field}.", f"{field}["))]
        if not matching:
            short_names = [name for name in source.names[: NAMES // 10] if len(name) < 200]
            near = difflib.get_close_matches(field, short_names, n=1)
            advice = f"did you mean {printable(near[0])}?" if near else "leave it out for a listing"
            raise ConfigurationError(
                f"{option} {printable(field)}: there is no such name; {advice}"
            )
        fields += matching
        called += [own or None] if len(matching) == 1 else [None] * len(matching)
    short = [name.rpartition("/")[2].partition(".")[2] or name for name in fields]
    counts = Counter(short)
    names = [
        own or (s if counts[s] == 1 else n) for own, s, n in zip(called, short, fields, strict=True)
    ]
    double, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise ConfigurationError(f"{option} {printable(double)}: given twice; expected it once")
    return fields, names


def _some(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(printable(name, 40) for name in names[:most])
