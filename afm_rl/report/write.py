"""Everything that several folders of results say, as tables, figures and one page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pandas as pd

from afm_rl.artefacts import write_whole
from afm_rl.report import style
from afm_rl.report.absent import absent_lines, absent_table, find_absent
from afm_rl.report.aggregate import aggregate, aggregate_table
from afm_rl.report.cells import cell_table
from afm_rl.report.collect import collect
from afm_rl.report.drawings import LoadTrack, all_figures
from afm_rl.report.events import folder_names
from afm_rl.report.flight_report import flight_figures, flight_tables
from afm_rl.report.gather import Gathered, gather
from afm_rl.report.heatmaps import mapped_cells
from afm_rl.report.kinds import FLIGHTS, kind_of
from afm_rl.report.outcomes import add_outcomes, budget_notes
from afm_rl.report.page import Picture, render_page
from afm_rl.report.pairs import compare, comparison_tables
from afm_rl.report.published import published_tables
from afm_rl.report.recovery import recovery_table
from afm_rl.report.scenarios import traced_missions
from afm_rl.report.table import Table

BASELINES = ("online_pe", "adaptive_affine")


def write_report(
    folders: Sequence[str | Path],
    out: str | Path,
    *,
    baselines: Sequence[str] = BASELINES,
    oracle: str = "oracle",
    figures: bool = True,
    load_track: LoadTrack | None = None,
    echo: Callable[[str], object] = print,
) -> Path:
    """Join the results of runs and studies; write tables, figures and ``index.html``.

    Files in ``out``: ``index.html``, which holds everything; ``tables/NAME.csv`` and
    ``tables/NAME.tex`` (for LaTeX with ``booktabs``); ``figures/NAME.png``; ``missing.csv``.
    Each is written whole or not at all; files of the same name are replaced. Partial results
    are welcome: what is missing is said. Flights have tables and figures of their own.

    Args:
        folders: of runs (``missions.csv``, ``steps.parquet``) or studies; of a mission that
            stands in several, the last one counts.
        out: where to; made if it is not there.
        baselines: methods that the others are compared with.
        oracle: the method that knows the regime.
        figures: draw figures.
        load_track: returns a track by name, to draw roads; may raise a ConfigurationError.
        echo: receives one line per thing to know.

    Returns:
        The path of ``index.html``.

    Raises:
        ConfigurationError: if a folder or a file in it cannot be used, or ``out`` cannot be
            written.
    """
    collection, out = collect(folders), Path(out)
    flights = kind_of(collection.missions) is FLIGHTS
    missions, notes = collection.missions, list(collection.notes)
    if not flights:
        missions = add_outcomes(missions)
        notes += budget_notes(missions)
        notes += [
            f"There are no missions of {name}: comparisons with it are left out."
            for name in dict.fromkeys([*baselines, oracle])
            if name not in collection.methods
        ]
    absent = find_absent(missions, collection.asked)
    cells = pd.concat([missions["cell"], collection.asked["cell"]]).nunique()
    summary = (
        f"{len(missions)} missions of {len(collection.methods)} methods in "
        f"{missions['cell'].nunique()} cells, from {', '.join(map(str, folders))}; "
        f"{len(absent)} missions are missing."
    )
    for line in (summary, *notes, *absent_lines(absent, collection.methods, cells)):
        echo(line)

    if flights:
        tables, drawn = list(flight_tables(missions)), flight_figures(collection)
    else:
        traced = traced_missions(missions[missions["file"] >= 0])
        mapped = mapped_cells(missions) if figures else []
        gathered = gather(collection, traced["mission"] if figures else [], mapped)
        means = aggregate(missions, collection.compute, oracle)
        tables = list(_tables(missions, means, gathered, baselines, oracle))
        drawn = all_figures(missions, means, traced, gathered, load_track)
    if len(absent):
        tables.insert(0, absent_table(absent, cells))
    for table in tables:
        (name,) = folder_names([table.name])
        write_whole(out / "tables" / f"{name}.csv", table.to_csv().encode())
        write_whole(out / "tables" / f"{name}.tex", table.to_latex().encode())
    write_whole(out / "missing.csv", absent.to_csv(index=False, lineterminator="\n").encode())
    echo(f"wrote {len(tables)} tables: {out / 'tables'}")
    pictures = []
    if figures:
        for name, title, caption, figure in drawn:
            png = style.png_bytes(figure)
            write_whole(out / "figures" / f"{folder_names([name])[0]}.png", png)
            pictures.append(Picture(name, title, caption, png))
        echo(f"wrote {len(pictures)} figures: {out / 'figures'}")
    title = f"Results: {len(collection.methods)} methods, {missions['cell'].nunique()} cells"
    page = render_page(title, summary, notes, tables, pictures)
    write_whole(out / "index.html", page.encode())
    echo(f"Report: {out / 'index.html'}")
    return out / "index.html"


def _tables(
    missions: pd.DataFrame,
    means: pd.DataFrame,
    gathered: Gathered,
    baselines: Sequence[str],
    oracle: str,
) -> Iterator[Table]:
    """Yield the tables in the order of the page."""
    yield aggregate_table(means, oracle)
    yield from comparison_tables(compare(missions, baselines))
    if gathered.recovery and sum(map(len, gathered.recovery)):
        yield recovery_table(pd.concat(gathered.recovery))
    yield cell_table(missions)
    yield from published_tables(missions)
