"""Everything that several folders of results say, as tables, figures and one page."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, StrictUndefined

from afm_rl.errors import ArtefactError
from afm_rl.report import style
from afm_rl.report.collect import Collection, collect
from afm_rl.report.comparisons import (
    aggregate,
    cell_table,
    compare,
    comparison_tables,
    rank_missions,
    summary_table,
)
from afm_rl.report.events import folder_names
from afm_rl.report.figures import draw_all, excerpts, telling_cells
from afm_rl.report.missing_runs import find_missing, missing_lines, missing_table
from afm_rl.report.recovery import recovery_table
from afm_rl.report.results_files import LONGEST, read_text
from afm_rl.report.summary import budget_notes, count_budgets
from afm_rl.report.table import Table
from afm_rl.report.track_plot import LoadTrack, load_tracks
from afm_rl.storage.csv_text import csv_text
from afm_rl.storage.files import write_whole
from afm_rl.storage.measures import Measures

TEMPLATE = Path(__file__).with_name("page.html")
REFERENCES = (
    "R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville, M. G. Bellemare: Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice. NeurIPS 2021 (interquartile mean, "
    "stratified bootstrap, probability of improvement, performance profiles).",
    "E. D. Dolan, J. J. Moré: Benchmarking optimization software with performance profiles. "
    "Mathematical Programming 91, 2002.",
)
BASELINES = ("online_pe", "adaptive_affine")


def write_report(
    folders: Sequence[str | Path],
    out: str | Path,
    *,
    baselines: Sequence[str] | None = None,
    oracle: str = "oracle",
    figures: bool = True,
    load_track: LoadTrack | None = None,
    echo: Callable[[str], object] = print,
) -> Path:
    """Join the results of runs and studies; write tables, figures and ``index.html``.

    Files in ``out``: ``index.html``, which holds everything; ``tables/NAME.csv`` and
    ``tables/NAME.tex`` (for LaTeX with ``booktabs``); ``figures/NAME.png``; ``missing.csv``.
    Each is written whole or not at all; files of the same name are replaced. Results may be
    incomplete: the report names what is missing.

    Args:
        folders: of runs, comparisons, sweeps or studies; of a mission that stands in several, the
            last one counts.
        out: where to; made if it is not there.
        baselines: methods that the others are compared with. None: those of
            :data:`BASELINES` that there are, or else the first method.
        oracle: the method that knows the regime.
        figures: draw figures.
        load_track: returns a track by name, to draw roads; may raise a ConfigurationError.
        echo: receives one line per thing to know.

    Returns:
        The path of ``index.html``.

    Raises:
        ConfigurationError: if a folder or a file in it cannot be used, or ``out`` cannot be
            written.
        ArtefactError: if a file is damaged.
    """
    collection, out = collect(folders), Path(out)
    measures = collection.measures
    missions = count_budgets(collection.missions, measures)
    notes = [*collection.notes, *budget_notes(collection.missions, measures)]
    notes += [f"{folder}: {sentence}" for folder in folders for sentence in _diagnosed(folder)]
    if baselines is None:
        baselines = [name for name in BASELINES if name in collection.methods]
        baselines = baselines or collection.methods[:1]
    notes += [
        f"There are no missions of {name}: comparisons with it are left out."
        for name in baselines
        if name not in collection.methods
    ]
    missing = find_missing(missions, collection.plan)
    cells = pd.concat([missions["cell"], collection.plan["cell"]]).nunique()
    summary = (
        f"{len(missions)} missions of {len(collection.methods)} methods in "
        f"{missions['cell'].nunique()} cells, from {', '.join(map(str, folders))}; "
        f"{len(missing)} missions are missing."
    )
    lost = [missing_table(missing, cells)] if len(missing) else []
    for line in (summary, *notes, *(line for table in lost for line in missing_lines(table))):
        echo(line)

    found = excerpts(collection, telling_cells(missions, measures) if figures else [])
    tables = [*_tables(missions, collection, found.recovery, baselines, oracle), *lost]
    for table in tables:
        (name,) = folder_names([table.name])
        write_whole(out / "tables" / f"{name}.csv", table.to_csv().encode())
        write_whole(out / "tables" / f"{name}.tex", table.to_latex().encode())
    write_whole(out / "missing.csv", csv_text(missing).encode())
    echo(f"wrote {len(tables)} tables: {out / 'tables'}")
    pictures = []
    if figures:
        tracks = load_tracks(missions["track"].unique(), load_track)
        for name, title, caption, figure in draw_all(missions, collection, found, tracks):
            png = style.png_bytes(figure)
            write_whole(out / "figures" / f"{folder_names([name])[0]}.png", png)
            data = base64.b64encode(png).decode()
            pictures.append({"name": name, "title": title, "caption": caption, "data": data})
        echo(f"wrote {len(pictures)} figures: {out / 'figures'}")
    title = f"Results: {len(collection.methods)} methods, {missions['cell'].nunique()} cells"
    content = {"title": title, "summary": summary, "notes": notes, "tables": tables}
    page = render_page(**content, figures=pictures, references=REFERENCES)
    write_whole(out / "index.html", page.encode())
    echo(f"Report: {out / 'index.html'}")
    return out / "index.html"


def _diagnosed(folder: str | Path) -> list[str]:
    """Return what a run found of its robot's actuators, one sentence each."""
    path = Path(folder) / "diagnosis" / "diagnosis.json"
    if not path.is_file():
        return []
    try:
        found = json.loads(read_text(path))["actuators"]
        return [str(actuator["sentence"])[:LONGEST] for actuator in found]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ArtefactError(f"{path}: damaged; delete it") from error


def render_page(**content: Any) -> str:
    """Return the page of a report: title, summary, notes, figures, tables and references."""
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(**content)


def _tables(
    missions: pd.DataFrame,
    collection: Collection,
    recovery: Sequence[pd.DataFrame],
    baselines: Sequence[str],
    oracle: str,
) -> Iterator[Table]:
    """Yield the tables in the order of the page."""
    measures: Measures = collection.measures
    means = aggregate(missions, measures, collection.compute, oracle)
    yield summary_table(means, measures, oracle)
    ranked = rank_missions(missions, measures)
    yield from comparison_tables(compare(ranked, measures, baselines), measures)
    if sum(map(len, recovery)):
        yield recovery_table(pd.concat(recovery))
    yield cell_table(missions, measures)
