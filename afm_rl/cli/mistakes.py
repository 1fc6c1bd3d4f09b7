"""Errors in one line, for people."""

from __future__ import annotations

from collections.abc import Iterator

from hydra.errors import HydraException, InstantiationException
from omegaconf.errors import OmegaConfBaseException

from afm_rl.errors import AFMError


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
            return _one_line(str(cause))
    for cause in chain:
        if isinstance(cause, InstantiationException):
            last = chain[-1]
            where = getattr(cause, "full_key", None) or "settings"
            return _one_line(str(cause) if last is cause else f"{where}: {last}")
        if isinstance(cause, HydraException | OmegaConfBaseException):
            return _one_line(str(cause))
        if isinstance(cause, OSError) and cause.strerror:
            return _one_line(f"{cause.filename}: {cause.strerror}")
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _one_line(text: str) -> str:
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("Set the env"))
