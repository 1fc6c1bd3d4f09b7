"""What an MJCF asks for, before anything is built of it."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from afm_rl.errors import ConfigurationError, printable, refusing

LARGEST = 1e15  # number that means anything
MOST = {  # of what some attributes ask for, multiplied
    ("width", "height"): 2**26,  # pixels
    ("nrow", "ncol"): 2**26,
    ("nuserdata", "nkey"): 2**20,
    ("iterations", "ls_iterations"): 10**6,
    ("noslip_iterations", "ccd_iterations", "sdf_iterations"): 10**6,
}
ELEMENTS = 100_000


def check_sizes(name: str, source: str | Path) -> None:
    """Refuse an MJCF with absurd numbers, or of which more is built than a robot needs.

    Files that it includes count, too.

    Args:
        name: of the setting, for messages.
        source: path of a file, or text that begins with ``<``.

    Raises:
        ConfigurationError: naming element and attribute.

    >>> many = '<replicate count="1000"><replicate count="1000"><geom/></replicate></replicate>'
    >>> check_sizes("dynamics.model", f"<mujoco><worldbody>{many}</worldbody></mujoco>")
    Traceback (most recent call last):
    afm_rl.errors.ConfigurationError: dynamics.model: 1001003 elements, including repeated ones; \
expected at most 100000
    """
    text, folder, met = str(source).strip(), "", set[str]()
    if not text.startswith("<"):
        folder, met = os.path.dirname(text), {os.path.realpath(text)}
        text = Path(text).read_text(errors="replace")
    with refusing(f"{name}: no XML"):
        elements = _elements(name, _parsed(text), folder, met)
    if elements > ELEMENTS:
        raise ConfigurationError(
            f"{name}: {elements} elements, including repeated ones; expected at most {ELEMENTS}"
        )


def _elements(name: str, element: ElementTree.Element, folder: str, met: set[str]) -> int:
    """Return how many elements are built of one, those of included files, too."""
    sizes = dict(_numbers(name, element))
    for keys, most in MOST.items():
        asked = math.prod(abs(n) for key in keys for n in sizes.get(key, ()))
        if asked > most:
            raise _refusal(name, element, keys, f"at most {most:g}, multiplied")
    file, inside = os.path.join(folder, element.get("file", "")), list(element)
    if element.tag == "include" and os.path.isfile(file) and os.path.realpath(file) not in met:
        met.add(os.path.realpath(file))
        inside.append(_parsed(Path(file).read_text(errors="replace")))
    count = math.prod(max(1, int(n)) for n in sizes.get("count", ()))
    return 1 + count * max(count > 1, sum(_elements(name, part, folder, met) for part in inside))


def _parsed(text: str) -> ElementTree.Element:
    """Return the root of an XML without its comments, in which MuJoCo allows anything."""
    return ElementTree.fromstring(re.sub("<!--.*?-->", "", text.strip(), flags=re.DOTALL))


def _numbers(name: str, element: ElementTree.Element) -> Iterator[tuple[str, list[float]]]:
    """Yield the attributes that are numbers, none of them absurd."""
    for key, text in element.attrib.items():
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            continue
        if not all(abs(number) < LARGEST for number in numbers) and key not in ("name", "class"):
            raise _refusal(name, element, (key,), f"finite numbers below {LARGEST:g}")
        yield key, numbers


def _refusal(
    name: str, element: ElementTree.Element, keys: tuple[str, ...], expected: str
) -> ConfigurationError:
    which = " ".join(filter(None, [element.tag, repr(element.get("name", ""))]))
    given = ", ".join(f"{key}={element.get(key)}" for key in keys if element.get(key))
    return ConfigurationError(f"{name}: {printable(f'{which}: {given}')}: expected {expected}")
