"""Write the comments of settings files from the options that they set.

    python -m afm_rl.cli.settings [FOLDER]

A comment behind a setting is what its option says of it; one in a line of its own is the file's.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

import afm_rl.conf
from afm_rl.errors import ConfigurationError
from afm_rl.options import options_of, parts_of
from afm_rl.trust import find_code


def commented(path: Path) -> str:
    """Return the text of a settings file, with the comments of all options that are known."""
    text = path.read_text(encoding="utf-8")
    lines, around = [], [(-1, yaml.safe_load(text), _target(path))]
    for line in text.splitlines():
        setting = re.fullmatch(r"( *)(\w+):((?: +[^ #][^#]*?)?)(?: +#.*)?", line)
        if setting:
            margin, key, value = setting.groups()
            indent = len(margin)
            around = [each for each in around if each[0] < indent]
            _, settings, target = around[-1]
            known = options_of(target) if target else {}
            if key in known:
                comment = re.sub(r"\b(True|False)\b", lambda m: m[0].lower(), known[key].text)
                comment = re.sub(r"\bNone\b", "null", comment)
                line = f"{margin}{key}:{value} # {comment}"
            inner = settings.get(key) if isinstance(settings, Mapping) else None
            if isinstance(inner, Mapping):
                part = _named(inner) or _target(path, key) or parts_of(target).get(key)
                around.append((indent, inner, part))
        lines.append(line)
    return "\n".join(lines) + "\n"


def _named(settings: Mapping[str, Any]) -> Any:
    with suppress(ConfigurationError):  # what is not installed says nothing
        return find_code("_target_", settings["_target_"]) if "_target_" in settings else None


def _target(path: Path, place: str = "") -> Any:
    """Return what the settings of a file, or those at a place in it, are for; None: nothing."""
    settings = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    if not place and "_target_" in settings:
        return _named(settings)
    for base in settings.get("defaults", ()):
        if isinstance(base, Mapping):  # the choice of a group
            base = "".join(f"{group}/{name}@{group}" for group, name in base.items())
        name, _, where = base.partition("@")
        if where == place and name != "_self_":
            return _target(path.parent / f"{name}.yaml")
    return None


def main() -> None:
    """Write the comments again, of the files of a folder or of this library."""
    folder = Path(sys.argv[1] if sys.argv[1:] else afm_rl.conf.__path__[0])
    for path in sorted(folder.rglob("*.yaml")):
        path.write_text(commented(path), encoding="utf-8")


if __name__ == "__main__":
    main()
