"""Error messages of one line."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from afm_rl.errors import AFMError, causes, printable
from afm_rl.options import moved


@contextmanager
def errors_in_one_line(
    name: str, launched: Sequence[bool] = (True,), again: bool = False
) -> Iterator[None]:
    """End a command after a mistake with one line, which begins with its name, and status 2.

    Args:
        name: of the command.
        launched: empty as long as whatever is raised is a mistake in the settings.
        again: raise it once more instead of exiting.
    """
    try:
        yield
    except BrokenPipeError:  # nobody reads on, as in `afm-rl-report study | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        message = explain(error)
        if message is None and not launched:
            message = f"settings: {error}" if str(error) else f"settings: {error!r}"
        if message is None:
            raise
        print(f"{name}: {printable(one_line(message), 4000)}", file=sys.stderr)
        if again:
            raise
        sys.exit(getattr(error, "status", 2))


class OneLineParser(argparse.ArgumentParser):
    """A parser of arguments; a mistake ends with one line of text and exit status 2."""

    def __init__(self, name: str, about: str | None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=name, description=about, formatter_class=raw)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong."""
        print(f"{self.prog}: {message} (see {self.prog} --help)", file=sys.stderr)
        sys.exit(2)


def explain(error: BaseException) -> str | None:
    """Return one line that says what is wrong with the settings, or None for other errors.

    >>> explain(FileNotFoundError(2, "No such file or directory", "track.csv"))
    'track.csv: No such file or directory'
    >>> explain(RuntimeError("a bug")) is None
    True
    """
    chain = list(causes(error))
    for cause in chain:
        if isinstance(cause, AFMError):
            return one_line(str(cause))
    for cause in chain:
        if isinstance(cause, HydraException | OmegaConfBaseException | YAMLError):
            unknown = re.search(r"Could not override '([^']+)'", str(cause))  # misspelt
            if unknown:
                return _unknown(unknown[1], sys.argv[1:])
            merging = str(cause).startswith("Error merging")  # Hydra keeps the reason to itself
            return one_line(f"{cause}: {cause.__cause__}" if merging else str(cause))
        if isinstance(cause, OSError) and cause.strerror:
            return one_line(f"{cause.filename or 'files'}: {cause.strerror}")
        memory = re.search("not enough memory|can't allocate memory|out of memory", str(cause))
        if isinstance(cause, MemoryError) or memory:
            return (
                "not enough memory: choose fewer tracks, regimes or seeds at a time, a smaller "
                "planner.candidates or a shorter planner.horizon"
            )
    return None


def _unknown(key: str, overrides: Sequence[str]) -> str:
    """Return the complaint about a setting that does not exist, with the nearest one."""
    if (message := moved(key)) is not None:
        return message
    near = nearest(key, _known(overrides))
    advice = f"did you mean {near}?" if near else "afm-rl --cfg job shows all settings"
    return f"{key}: there is no such setting; {advice}"


def nearest(key: str, known: Sequence[str]) -> str | None:
    """Return the known setting that a misspelt one is most like.

    >>> nearest("planner.horizn", ["planner.horizon", "planner.sigma", "budget"])
    'planner.horizon'
    >>> nearest("xyz", ["planner.horizon", "budget"]) is None
    True
    """
    matches = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if not matches:  # the right name in the wrong place
        last = [name for name in known if name.rpartition(".")[2] == key.rpartition(".")[2]]
        matches = difflib.get_close_matches(key, last, n=1, cutoff=0.0)
    return matches[0] if matches else None


def _known(overrides: Sequence[str]) -> list[str]:
    """Return all settings of the choices among the overrides, as far as these can be composed."""
    choices = [text for text in overrides if re.fullmatch(r"\w+=\w+", text)]
    for chosen in (choices, []):
        GlobalHydra.instance().clear()
        try:
            with initialize_config_module("afm_rl.conf", version_base="1.3"):
                cfg = compose("config", chosen)
            return list(places_of(OmegaConf.to_container(cfg, resolve=False)))
        except (HydraException, OmegaConfBaseException):
            continue
    return []


def places_of(settings: Any, begin: str = "") -> Iterator[str]:
    """Yield the names of all settings.

    >>> list(places_of({"corrector": {"noise": 0.1}}))
    ['corrector', 'corrector.noise']
    """
    if isinstance(settings, Mapping):
        for key, value in settings.items():
            yield f"{begin}{key}"
            yield from places_of(value, f"{begin}{key}.")


def one_line(text: str) -> str:
    r"""Put a message of several lines into one; indented lines are the items of a list.

    >>> one_line("Choose one of:\n\tcem\n\tmppi\nConfig search path:\n\tsomewhere")
    'Choose one of: cem, mppi'
    """
    text = re.split("Config search path:|Set the env|See https://", text)[0]  # Hydra's advice
    joined = ""
    for line in filter(str.strip, text.splitlines()):
        item = line[0].isspace() and bool(joined) and not joined.endswith(":")
        joined += (", " if item else " ") + " ".join(line.split())
    return joined.strip()
