"""Which of the names are commands, and which are their responses."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from afm_rl.diagnosis.readers.source import Source, Unchosen
from afm_rl.errors import ConfigurationError, printable

Pairs = tuple[list[str], list[str]]
"""Names of the first and of the second group."""

ACTIONS = ("action", "actions")  # LeRobot's words, and older ones
STATES = ("observation.state", "state", "states", "observation.states")


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

    Raises:
        Unchosen: if nothing was given, and nothing begins as expected; it has a listing.
        ConfigurationError: if what was given does not fit.
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
    found = [[n for n in source.names if n.startswith(f"{kind}.")] for kind in kinds]
    heads = list(kinds)
    if not all(found):
        found, heads = map(list, zip(*(_group(source, h) for h in (ACTIONS, STATES)), strict=True))
    if not all(found):
        if source.topics is not None:
            raise Unchosen(
                f"{len(source.names)} fields of {len(source.topics)} topics: name commands and "
                "responses, with --command TOPIC.FIELD --response TOPIC.FIELD",
                source.listing(),
            )
        raise Unchosen(
            f"columns {_some(source.names) or 'none'}: expected {kinds[0]}.NAME and "
            f"{kinds[1]}.NAME; rename them, or name what is there with --command and --response",
            source.listing(),
        )
    first, second = ([n[len(h) + 1 :] for n in g] for g, h in zip(found, heads, strict=True))
    if not paired:
        return (found[0], found[1]), (first, second), ()
    alone = sorted(set(first) - set(second)) or sorted(set(second) - set(first))
    if set(first) - set(second):
        alone = sorted(set(first) ^ set(second))
        raise ConfigurationError(
            f"{_some(alone)}: expected a command and a response of each actuator, under the same "
            "name; or name them in pairs, with --command and --response"
        )
    notes = (f"responses without a command were left out: {_some(alone)}",) if alone else ()
    partner = dict(zip(second, found[1], strict=True))
    return (found[0], [partner[name] for name in first]), (first, first), notes


def _group(source: Source, heads: Sequence[str]) -> tuple[list[str], str]:
    """Return the names under the first of some heads that there is, and that head."""
    for head in heads:
        names = [name for name in source.names if name.startswith(f"{head}.")]
        if names:
            return names, head
    return [], ""


def _expanded(source: Source, option: str, given: Sequence[str]) -> Pairs:
    """Return the fields that were given, and what to call them."""
    fields: list[str] = []
    called: list[str | None] = []
    for text in given:
        own, _, field = text.rpartition("=")
        if text in source.names:
            own, field = "", text
        found = [field] if field in source.names else []
        found = found or [n for n in source.names if n.startswith((f"{field}.", f"{field}["))]
        if not found:
            near = difflib.get_close_matches(field, source.names, n=1)
            advice = f"did you mean {printable(near[0])}?" if near else "leave it out for a listing"
            raise ConfigurationError(
                f"{option} {printable(field)}: there is no such name; {advice}"
            )
        fields += found
        called += [own or None] if len(found) == 1 else [None] * len(found)
    short = [name.rpartition("/")[2].partition(".")[2] or name for name in fields]
    names = [
        own or (s if short.count(s) == 1 else n)
        for own, s, n in zip(called, short, fields, strict=True)
    ]
    if len(set(names)) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise ConfigurationError(f"{option} {printable(double)}: given twice; expected it once")
    return fields, names


def _some(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(printable(name, 40) for name in names[:most])
