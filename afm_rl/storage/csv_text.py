"""Tables as CSV that a spreadsheet can open without running what stands in it."""

from __future__ import annotations

import re

import pandas as pd

_FORMULA = re.compile(r"[=+\-@\t\r]")  # how a formula begins
_QUOTED = re.compile(r"'(?=[=+\-@\t\r])")


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as CSV; a text that looks like a formula gets an apostrophe in front.

    >>> print(csv_text(pd.DataFrame({"method": ["=cmd|' /C calc'!A0", "-1.5"]})), end="")
    method
    '=cmd|' /C calc'!A0
    -1.5
    """
    texts = table.select_dtypes(["object", "string", "category"])
    safe = {name: texts[name].map(_quote) for name in texts}
    return table.assign(**safe).to_csv(index=False, lineterminator="\n")


def plain_text(text: object) -> object:
    """Return a cell as it was before :func:`csv_text` put an apostrophe in front.

    >>> plain_text("'=1+1"), plain_text("'tis")
    ('=1+1', "'tis")
    """
    return text[1:] if isinstance(text, str) and _QUOTED.match(text) else text


def _quote(cell: object) -> object:
    if not isinstance(cell, str) or not _FORMULA.match(cell):
        return cell
    try:
        float(cell)
        return cell
    except ValueError:
        return f"'{cell}"
