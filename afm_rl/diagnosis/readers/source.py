"""What a reader gives: names, and a function that reads some of them."""

from __future__ import annotations

import re
import stat
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from afm_rl.errors import ConfigurationError, printable


@dataclass(frozen=True)
class Source:
    """What a file or folder holds.

    Args:
        path: of the file or folder.
        names: of all numbers that were logged, such as ``/cmd_vel.linear.x``.
        read: returns, for some of the names, values ``(N,)``, NaN where one is missing. In a table
            all have the same rows; messages also come with their times.
        frame: time between command and response of a healthy robot (s).
        time: name of the time (s) among the names, or None.
        episode: name of the number of the episode among the names, or None.
        topics: of messages, how many there are of each topic; names begin with the topic.
        notes: what a reader must know.
    """

    path: Path
    names: Sequence[str]
    read: Callable[[Sequence[str]], Mapping[str, Series]]
    frame: float = 0.0
    time: str | None = None
    episode: str | None = None
    topics: Mapping[str, int] | None = None
    notes: tuple[str, ...] = ()

    def listing(self) -> list[str]:
        """Return what there is: a line for each topic, or for each column.

        >>> names = ["/arm.pos[0]", "/arm.pos[1]", "/arm.mode"]
        >>> Source(Path("log.mcap"), names, lambda wanted: {}, topics={"/arm": 5}).listing()
        ['/arm (5 messages): pos[0..1], mode']
        """
        if self.topics is None:
            return [printable(name) for name in self.names]
        lines = []
        for topic, count in sorted(self.topics.items()):
            own = [name[len(topic) + 1 :] for name in self.names if name.startswith(f"{topic}.")]
            fields = Counter(re.sub(r"\[\d+\]$", "[]", name) for name in own)
            shown = ", ".join(f.replace("[]", f"[0..{n - 1}]") for f, n in fields.items())
            lines.append(printable(f"{topic} ({count} messages): {shown}", 2000))
        return lines


@dataclass(frozen=True)
class Series:
    """Values ``(N,)``; of messages also their times (s), of a table the number of each row."""

    values: np.ndarray
    t: np.ndarray | None = None
    row: np.ndarray | None = None


@dataclass(frozen=True)
class Columns:
    """Commands and responses, as arrays.

    Args:
        names: of the commands, and of the responses.
        first: commands or actions, ``(N, A)``.
        second: responses or states, ``(N, S)``.
        t: times (s), ``(N,)``.
        episode: numbers of episodes, ``(N,)``.
        row: numbers of the rows in the file, ``(N,)``.
        read_from: rows of the file.
        frame: time between command and response of a healthy robot (s).
        notes: what a reader must know.
        effort: how hard the motors were driven, ``(M,)`` each.
    """

    names: tuple[Sequence[str], Sequence[str]]
    first: np.ndarray
    second: np.ndarray
    t: np.ndarray
    episode: np.ndarray
    row: np.ndarray
    read_from: int
    frame: float = 0.0
    notes: tuple[str, ...] = ()
    effort: Mapping[str, np.ndarray] = field(default_factory=dict)


class Unchosen(ConfigurationError):
    """It is not known what is a command and what a response.

    Args:
        message: one line.
        listing: what there is, a line each.
    """

    def __init__(self, message: str, listing: Sequence[str]) -> None:
        super().__init__(message)
        self.listing = list(listing)


def check_regular(path: Path) -> Path:
    """Return a path if it leads to a file that ends.

    Raises:
        ConfigurationError: for what cannot be read, a device, a pipe.
    """
    try:
        kind = path.stat().st_mode
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
    return path
