"""Results as files: figures and curves of a run; tables, figures and one page of many."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, StrictUndefined

from afm_rl.errors import ArtefactError, ConfigurationError, refusing
from afm_rl.film import ENCODERS, captioned, shown
from afm_rl.report.figures import draw_report, draw_run, read_excerpts
from afm_rl.report.learning import recovery_table
from afm_rl.report.runs import Runs, steps_of
from afm_rl.report.scenes import films_of, state_of
from afm_rl.report.statistics import aggregate, budget_notes, compare, count_budgets
from afm_rl.report.tables import (
    comparison_tables,
    missing_table,
    scenario_table,
    summary_table,
)
from afm_rl.report.trajectory import DrawableTrack
from afm_rl.report.untrusted import LONGEST, read_text
from afm_rl.storage.files import csv_text, file_name, write_whole
from afm_rl.storage.measures import Measures

BASELINES = ("online_pe", "adaptive_affine")
REFERENCES = (
    "R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville, M. G. Bellemare: Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice. NeurIPS 2021 (interquartile mean, "
    "stratified bootstrap).",
)


def write_run(
    folder: str | Path,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack] = (),
    *,
    echo: Callable[[str], object] = print,
) -> list[Path]:
    """Write figures of one method or several.

    Files: ``figures/trajectory.png`` (if the steps have ``x`` and ``y``) or, of robots in space,
    ``figures/space.png``, ``figures/learning.png``, ``figures/summary.png`` (if a method has more
    than one mission). Each is written whole or not at all; files of the same name are replaced,
    others left alone.

    Args:
        folder: where to; made if it is not there.
        missions: one row per mission.
        steps: one row per mission and step.
        measures: what methods are compared by.
        tracks: tracks to draw, found by name.
        echo: receives one line per thing written.

    Returns:
        The files written.

    Raises:
        ConfigurationError: if the folder cannot be written.
    """
    folder, written = Path(folder), []
    for picture in draw_run(missions, steps, measures, tracks):
        written.append(folder / "figures" / f"{picture.name}.png")
        write_whole(written[-1], picture.png)
        echo(f"wrote {written[-1]}")
    return written


def write_films(
    folder: Path,
    runs: Runs,
    tracks: Sequence[DrawableTrack] = (),
    form: str = "gif",
    echo: Callable[[str], object] = print,
    draw: Callable[[pd.DataFrame], Iterable[np.ndarray]] | None = None,
) -> list[Path]:
    """Write a film of each method's first mission, ``METHOD.gif`` or ``METHOD.mp4``.

    Several methods on a map, six at most, are in one film (``all_methods.gif``), which ends soon
    after the last one finished. A film has at most 150 frames, 15 a
    second, whatever the length of the mission. Files of the same name are replaced; each is
    written whole or not at all.

    Args:
        folder: where to; made if it is not there.
        runs: the results; see :data:`~afm_rl.report.scenes.COLUMNS` for what their steps must have.
        tracks: tracks to draw, found by name.
        form: ``"gif"`` or ``"mp4"``.
        echo: receives one line per film.
        draw: returns pictures of a mission's steps, for robots that are not on a map. A caption
            above them has method, scenario, step, and whether there is a fault and a correction.

    Returns:
        The files written.

    Raises:
        ConfigurationError: if there are no steps, a column is missing, or the folder cannot be
            written.
    """
    first = runs.with_steps.drop_duplicates("method")
    if first.empty:
        where = ", ".join(map(str, runs.folders))
        raise ConfigurationError(f"{where}: no steps.parquet; films are drawn from it")
    steps = runs.steps(first)
    each = steps_of(steps, first["mission"])
    missions = {m.method: each.get(m.mission, steps.iloc[:0]) for m in first.itertuples()}
    films: Iterable[tuple[str, Iterable[np.ndarray]]]
    if draw is None:
        films = films_of(first, missions, {track.name: track for track in tracks})
    else:
        titles = dict(zip(first["method"], first["scenario"], strict=True))
        films = (
            (name, drawn(f"{name}: {titles[name]}", rows.iloc[shown(len(rows))], draw))
            for name, rows in missions.items()
        )
    written = []
    for method, pictures in films:
        written.append(folder / f"{file_name(method or 'all_methods')}.{form}")
        write_whole(written[-1], ENCODERS[form](pictures))
        echo(f"wrote {written[-1]}")
    return written


def drawn(
    title: str, steps: pd.DataFrame, draw: Callable[[pd.DataFrame], Iterable[np.ndarray]]
) -> Iterator[np.ndarray]:
    """Yield the pictures of steps with their captions."""
    captions = (f"{title}\n{state_of(step)}" for _, step in steps.iterrows())
    yield from captioned(draw(steps), captions)


def write_report(
    runs: Runs,
    out: str | Path,
    tracks: Sequence[DrawableTrack] = (),
    *,
    baselines: Sequence[str] | None = None,
    oracle: str = "oracle",
    figures: bool = True,
    echo: Callable[[str], object] = print,
) -> Path:
    """Write tables, figures and ``index.html`` of the results of runs and studies.

    Files in ``out``: ``index.html``, which holds everything; ``tables/NAME.csv``;
    ``figures/NAME.png``; ``missing.csv``.
    Each is written whole or not at all; files of the same name are replaced. Results may be
    incomplete: the report names what is missing.

    Args:
        runs: from :func:`~.runs.read_runs`.
        out: where to; made if it is not there.
        tracks: tracks to draw, found by name; a map whose track is not here has no road.
        baselines: methods that the others are compared with. None: those of :data:`BASELINES` that
            there are, or else the first method.
        oracle: the method that knows the regime.
        figures: draw figures.
        echo: receives one line per thing to know.

    Returns:
        The path of ``index.html``.

    Raises:
        ConfigurationError: if a file cannot be used, or ``out`` cannot be written.
        ArtefactError: if a file is damaged.
    """
    # What a reader must know of the results.
    out, measures = Path(out), runs.measures
    missions, missing = count_budgets(runs.missions, measures), runs.missing
    scenarios = missions["scenario"].nunique()
    if baselines is None:
        baselines = [name for name in BASELINES if name in runs.methods] or runs.methods[:1]
    summary = (
        f"{len(missions)} missions of {len(runs.methods)} methods in {scenarios} scenarios, from "
        f"{', '.join(map(str, runs.folders))}; {len(missing)} missions are missing."
    )
    notes = [*_notes(runs, baselines)]
    for line in (summary, *notes):
        echo(line)
    # Tables, figures, and the page that holds them all.
    recovery, progress = read_excerpts(runs)
    tables = [
        summary_table(aggregate(missions, measures), measures, oracle),
        *comparison_tables(compare(missions, measures, baselines), measures),
        *([recovery_table(recovery)] if len(recovery) else []),
        scenario_table(missions, measures),
        *([missing_table(missing, scenarios)] if len(missing) else []),
    ]
    for table in tables:
        write_whole(out / "tables" / f"{file_name(table.name)}.csv", table.to_csv().encode())
    write_whole(out / "missing.csv", csv_text(missing).encode())
    echo(f"wrote {len(tables)} tables: {out / 'tables'}")
    pictures = list(draw_report(runs, missions, progress, tracks)) if figures else []
    for picture in pictures:
        write_whole(out / "figures" / f"{file_name(picture.name)}.png", picture.png)
    if pictures:
        echo(f"wrote {len(pictures)} figures: {out / 'figures'}")
    title = f"Results: {len(runs.methods)} methods, {scenarios} scenarios"
    content = {"title": title, "summary": summary, "notes": notes, "tables": tables}
    page = render_page(**content, figures=pictures, references=REFERENCES)
    write_whole(out / "index.html", page.encode())
    echo(f"Report: {out / 'index.html'}")
    return out / "index.html"


def _notes(runs: Runs, baselines: Sequence[str]) -> Iterator[str]:
    """Yield what a reader must know of the results, and what each run found of its robot."""
    yield from (*runs.lost, *runs.notes, *budget_notes(runs.missions, runs.measures))
    for folder in runs.folders:
        yield from (f"{folder}: {sentence}" for sentence in _found(folder))
    for name in baselines:
        if name not in runs.methods:
            yield f"There are no missions of {name}: comparisons with it are omitted."


def _found(folder: Path) -> Iterator[str]:
    """Yield what a run found of its robot's actuators, one sentence each."""
    path = folder / "diagnosis" / "diagnosis.json"
    with refusing(f"{path}: damaged; delete it", ArtefactError):
        for actuator in json.loads(read_text(path))["actuators"] if path.is_file() else ():
            yield str(actuator["sentence"])[:LONGEST]


def render_page(**content: Any) -> str:
    """Return a page that needs no other file: title, summary, notes, figures, tables, references.

    Figures have the attributes or entries ``name``, ``title``, ``caption`` and ``data``, the PNG
    file in base 64.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return environment.from_string(template).render(**content)
