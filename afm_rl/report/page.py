"""A report as one file for a browser."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from afm_rl.report.table import Table

TEMPLATE = Path(__file__).with_name("page.html")


@dataclass(frozen=True)
class Picture:
    """A figure of the report.

    Attributes:
        name: file name, without an ending.
        title: a few words.
        caption: how to read it.
        png: the picture.
    """

    name: str
    title: str
    caption: str
    png: bytes

    @property
    def data(self) -> str:
        """The picture as text (base64)."""
        return base64.b64encode(self.png).decode()


def render_page(
    title: str,
    summary: str,
    notes: Sequence[str],
    tables: Sequence[Table],
    figures: Sequence[Picture],
) -> str:
    """Return an HTML page that needs no other file and no network.

    >>> "<h1>a &lt; b</h1>" in render_page("a < b", "", [], [], [])
    True
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        title=title, summary=summary, notes=notes, tables=tables, figures=figures
    )
