"""Errors that say what was given, what was expected and what to do."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any

LIBRARIES = {"afm_rl", "gymnasium", "stable_baselines3", "tensordict", "torch", "torchrl"}


class AFMError(Exception):
    """Base class of every error this library raises on purpose."""


class ConfigurationError(AFMError, ValueError):
    """A setting, argument or file that cannot be used."""


class ArtefactError(AFMError, ValueError):
    """A stored model that is damaged or belongs to something else."""


class NonFiniteError(AFMError, ValueError):
    """NaN or infinity where a finite number is needed."""


def warn(text: str) -> None:
    """Warn, at the newest line that is neither in this library nor in those around it.

    >>> with warnings.catch_warnings(record=True) as said:
    ...     check_count("horizon", 5), warn("a plan of NaN")
    (5, None)
    >>> str(said[0].message)
    'a plan of NaN'
    """
    frame, level = sys._getframe(1), 2
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in LIBRARIES:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, stacklevel=level)


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and what led to it, the latest first, each once: omegaconf makes rings.

    >>> first, second = ValueError("first"), KeyError("second")
    >>> first.__cause__, second.__cause__ = second, first
    >>> list(causes(first))
    [ValueError('first'), KeyError('second')]
    """
    met: list[BaseException] = []
    while error is not None and not any(error is one for one in met):
        met.append(error)
        yield error
        error = error.__cause__ or error.__context__


def printable(name: str, longest: int = 80) -> str:
    r"""Return a name that no terminal takes for an order, and that fits on a line.

    >>> printable("pan\x1b[31m"), printable("x" * 100)[-4:]
    ('pan?[31m', 'x...')
    """
    clean = "".join(letter if letter.isprintable() else "?" for letter in name[: 2 * longest])
    return clean if len(clean) <= longest else f"{clean[: longest - 3]}..."


@contextmanager
def refusing(said: str, kind: type[AFMError] = ConfigurationError) -> Iterator[None]:
    """Turn errors of other code or files into an error of ours with a message of one line.

    >>> with refusing("model.zip: no model in it", ArtefactError):
    ...     {}["data"]
    Traceback (most recent call last):
        ...
    afm_rl.errors.ArtefactError: model.zip: no model in it: 'data'
    """
    try:
        yield
    except AFMError:
        raise
    except Exception as error:  # of any kind
        reason = str(getattr(error, "strerror", None) or error)
        line = " ".join(reason.split()) or type(error).__name__
        raise kind(f"{said}: {printable(line, 300)}") from error


def check_number(
    name: str,
    value: float,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    open_low: bool = False,
) -> float:
    """Return ``value`` as a float in ``[low, high]`` (``(low, high]`` if ``open_low``).

    Raises:
        ConfigurationError: if it is not a finite number in that range.

    >>> check_number("temperature", 0.5, low=0, open_low=True)
    0.5
    """
    allowed = f"a finite number in {'(' if open_low else '['}{low:g}, {high:g}]"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ConfigurationError(f"{name}={value!r}: expected {allowed}")
    if value > high or value < low or (open_low and value == low):
        raise ConfigurationError(f"{name}={value!r}: expected {allowed}")
    return float(value)


def check_count(name: str, value: int, *, low: int = 1, high: int = 2**63 - 1) -> int:
    """Return ``value`` if it is a whole number in ``[low, high]``.

    Raises:
        ConfigurationError: otherwise.

    >>> check_count("horizon", 5)
    5
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ConfigurationError(f"{name}={value!r}: expected a whole number of at least {low}")
    if value > high:
        raise ConfigurationError(f"{name}={value!r}: expected a whole number of at most {high}")
    return value


def check_indices(name: str, indices: Iterable[int], size: int) -> list[int]:
    """Return indices of so many coordinates, if they are distinct.

    Raises:
        ConfigurationError: otherwise.

    >>> check_indices("planner.bounded", [0], 4)
    [0]
    """
    indices = list(indices)
    fits = all(type(index) is int and 0 <= index < size for index in indices)
    if not fits or len(set(indices)) < len(indices):
        raise ConfigurationError(f"{name}={indices}: expected distinct indices in 0..{size - 1}")
    return indices


def check_choice(name: str, value: str, allowed: Iterable[str]) -> str:
    """Return ``value`` if it is one of ``allowed``.

    Raises:
        ConfigurationError: otherwise, listing what is allowed.

    >>> check_choice("by", "step", ("progress", "step"))
    'step'
    """
    allowed = tuple(allowed)
    if value not in allowed:
        near = get_close_matches(str(value), [str(each) for each in allowed], 1)
        meant = f"; did you mean {near[0]!r}?" if near else ""
        raise ConfigurationError(f"{name}={value!r}: expected one of {', '.join(allowed)}{meant}")
    return value


def check_flag(name: str, value: bool) -> bool:
    """Return ``value`` if it is true or false.

    Raises:
        ConfigurationError: otherwise.

    >>> check_flag("enabled", True)
    True
    """
    if not isinstance(value, bool):
        raise ConfigurationError(f"{name}={value!r}: expected true or false")
    return value


def check_instance(name: str, value: Any, kind: type) -> Any:
    """Return ``value`` if it is an instance of ``kind``.

    Raises:
        ConfigurationError: otherwise, naming both types.

    >>> check_instance("planner.env", 3, int)
    3
    """
    if not isinstance(value, kind):
        shown = " ".join(repr(value).split())  # modules are described in several lines
        raise ConfigurationError(f"{name}: expected a {kind.__name__}, got {shown:.80}")
    return value
