"""Progress of long work: a bar in a terminal, a line every ten seconds elsewhere."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm


class Bar(tqdm):
    """A tqdm bar that suits both terminals and log files.

    Off a terminal it writes a line to standard error every ten seconds.

    Args:
        *args: as of ``tqdm``.
        shown: show anything at all.
        main: what this bar measures is the work itself; others measure what prepares it, such as a
            training, and the share of the work done is 0 meanwhile.
        form: what it says behind the share, in the words of ``bar_format``.
        **settings: as of ``tqdm``.

    Attributes:
        listener: if set, receives the share of the work done, once a second, and nothing is shown.

    >>> sum(Bar(range(3), desc="adding", shown=False))
    3
    """

    listener: Callable[[float], None] | None = None
    # tqdm's own lock is one for all forked processes: one killed while it holds it stops the rest.
    _lock = threading.RLock()
    monitor_interval = 0  # no thread that could hold the lock while a process forks

    def __init__(
        self,
        *args: Any,
        shown: bool = True,
        main: bool = False,
        form: str = "{elapsed} so far, {remaining} left{postfix}",
        **settings: Any,
    ) -> None:
        self.main = main
        self.live, self.begun = sys.stderr.isatty() and Bar.listener is None, False
        often = 0.1 if self.live else 1.0 if Bar.listener else 10.0
        share = "{percentage:3.0f} %|{bar}|" if self.live else "{percentage:.0f} %,"
        form = f"{{desc}}: {share} {form}"
        shown = shown or Bar.listener is not None
        defaults = {"mininterval": often, "miniters": 1, "bar_format": form, "leave": self.live}
        super().__init__(*args, disable=not shown, **defaults | settings)
        self.begun = True

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Show the present state."""
        if self.live:
            super().display(msg, pos)
        elif self.begun and msg is None:
            if Bar.listener:
                Bar.listener(self.n / self.total if self.main and self.total else 0.0)
            else:
                print(self, file=sys.stderr, flush=True)


@contextmanager
def waiting(what: str, expected: float, every: float = 1.0) -> Iterator[Bar]:
    """Show how much of an expected time has passed; what takes longer counts as nearly done.

    Args:
        what: is waited for.
        expected: how long it may take (s).
        every: how often it is looked at (s).
    """
    ended = threading.Event()

    def show() -> None:
        while not ended.wait(every):
            bar.total = max(bar.total, 1.1 * (bar.n + every))
            bar.update(every)

    with Bar(total=expected, desc=what) as bar:
        clock = threading.Thread(target=show, daemon=True)
        clock.start()
        try:
            yield bar
        finally:
            ended.set()
            clock.join()
