"""Errors in one line, for people."""

from __future__ import annotations

from collections.abc import Iterator

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from afm_rl.errors import AFMError

NOISE = ("Config search path:", "Set the env", "See https://")  # of no help here


def explain(error: BaseException) -> str | None:
    """Return one line that says what is wrong with the settings, or None for other errors.

    >>> explain(FileNotFoundError(2, "No such file or directory", "track.csv"))
    'track.csv: No such file or directory'
    >>> explain(RuntimeError("a bug")) is None
    True
    """
    chain = list(_causes(error))
    for cause in chain:
        if isinstance(cause, AFMError):
            return one_line(str(cause))
    for cause in chain:
        if isinstance(cause, HydraException | OmegaConfBaseException | YAMLError):
            merging = str(cause).startswith("Error merging")  # Hydra keeps the reason to itself
            return one_line(f"{cause}: {cause.__cause__}" if merging else str(cause))
        if isinstance(cause, OSError) and cause.strerror:
            return one_line(f"{cause.filename or 'files'}: {cause.strerror}")
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def one_line(text: str) -> str:
    r"""Put a message of several lines into one; indented lines are the items of a list.

    >>> one_line("Choose one of:\n\tcem\n\tmppi\nConfig search path:\n\tsomewhere")
    'Choose one of: cem, mppi'
    """
    for noise in NOISE:
        text = text.partition(noise)[0]
    joined = ""
    for line in filter(str.strip, text.splitlines()):
        item = line[0].isspace() and bool(joined) and not joined.endswith(":")
        joined += (", " if item else " ") + " ".join(line.split())
    return joined.strip()
