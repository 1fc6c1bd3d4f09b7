"""Films of missions, drawn from the table of steps."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from afm_rl.artefacts import write_whole
from afm_rl.errors import ConfigurationError
from afm_rl.report.collect import collect
from afm_rl.report.drawings import LoadTrack, load_tracks
from afm_rl.report.events import folder_names
from afm_rl.report.frames import cell_names, steps_of
from afm_rl.report.kinds import FLIGHTS, kind_of
from afm_rl.report.results_files import read_steps
from afm_rl.report.road import DrawableTrack
from afm_rl.report.scenes import (
    DRIVE_COLUMNS,
    FLIGHT_COLUMNS,
    Scene,
    drive_scene,
    flight_scene,
)

FRAMES, RATE = 150, 15  # at most; per second
DPI, COLOURS = 100, 128
LAST = 1500  # ms, how long the last frame of a GIF stays


def check_video(video: bool | str) -> str | None:
    """Return the kind of film that is asked for, ``gif`` where none is named, or None.

    Raises:
        ConfigurationError: if there is no such kind, or what writes it is not installed.

    >>> check_video(True), check_video(False)
    ('gif', None)
    """
    if isinstance(video, bool):
        return "gif" if video else None
    if video not in ENCODERS:
        raise ConfigurationError(f"video={video!r}: expected false, true, gif or mp4")
    needed = ("imageio", "imageio_ffmpeg") if video == "mp4" else ()
    if not all(importlib.util.find_spec(name) for name in needed):
        raise ConfigurationError(
            "video=mp4: imageio and imageio-ffmpeg are not installed; install afm-rl[video], or "
            "choose video=gif"
        )
    return video


def write_films(
    folder: Path,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    tracks: Sequence[DrawableTrack] = (),
    form: str = "gif",
    echo: Callable[[str], object] = print,
) -> list[Path]:
    """Write a film of each method's first mission, ``METHOD.gif`` or ``METHOD.mp4``.

    A film has at most 150 frames, 15 a second, whatever the length of the mission. Files of the
    same name are replaced; each is written whole or not at all.

    Args:
        folder: where to; made if it is not there.
        missions: one row per mission.
        steps: one row per mission and step; see :data:`~.scenes.DRIVE_COLUMNS` and
            :data:`~.scenes.FLIGHT_COLUMNS`.
        tracks: tracks to draw, found by name.
        form: ``"gif"`` or ``"mp4"``.
        echo: receives one line per film.

    Returns:
        The files written.

    Raises:
        ConfigurationError: if a column is missing, or the folder cannot be written.
    """
    encode, roads = ENCODERS[form], {track.name: track for track in tracks}
    flights = kind_of(missions) is FLIGHTS
    first = missions.assign(cell=cell_names(missions)).drop_duplicates("method")
    rows = steps_of(steps, first["mission"])
    written = []
    for mission, name in zip(first.itertuples(), folder_names(first["method"]), strict=True):
        told = rows.get(mission.mission, steps.iloc[:0])
        _check_columns(told, FLIGHT_COLUMNS if flights else DRIVE_COLUMNS)
        title = f"{mission.method}: {mission.cell}"
        if flights:
            scene = flight_scene(title, told)
        else:
            scene = drive_scene(title, told, roads.get(mission.track))
        write_whole(folder / f"{name}.{form}", encode(frames(scene, len(told))))
        written.append(folder / f"{name}.{form}")
        echo(f"wrote {written[-1]}")
    return written


def film_results(
    folders: Sequence[str | Path],
    out: Path,
    form: str = "gif",
    load_track: LoadTrack | None = None,
    echo: Callable[[str], object] = print,
) -> list[Path]:
    """Write films of results on disk, see :func:`write_films`.

    Args:
        folders: of runs or studies.
        out: where to.
        form: ``"gif"`` or ``"mp4"``.
        load_track: returns a track by name, to draw roads; may raise a ConfigurationError.
        echo: receives one line per film.

    Raises:
        ConfigurationError: if a folder cannot be used, or holds no steps.
    """
    collection = collect(folders)
    known = collection.missions[collection.missions["file"] >= 0]
    if known.empty:
        raise ConfigurationError(
            f"{', '.join(map(str, folders))}: no steps.parquet; films are drawn from it"
        )
    first = known.drop_duplicates("method")
    columns = FLIGHT_COLUMNS if kind_of(first) is FLIGHTS else (*DRIVE_COLUMNS, "miss")
    tracks = load_tracks(first["track"].unique(), load_track)
    return write_films(out, first, read_steps(collection.files, first, columns), tracks, form, echo)


def frames(scene: Scene, count: int) -> Iterator[np.ndarray]:
    """Yield the pictures ``(height, width, 3)`` of a mission of ``count`` steps.

    What does not move is drawn once; the rest is drawn over it.
    """
    figure, canvas = scene.figure, cast(FigureCanvasAgg, scene.figure.canvas)
    figure.set_dpi(DPI)
    scene.show(0)  # texts take the room that they need
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for artist in scene.moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for row in np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int)):
        canvas.restore_region(background)
        scene.show(int(row))
        for artist in scene.moving:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _check_columns(steps: pd.DataFrame, columns: Sequence[str]) -> None:
    missing = [name for name in columns if name not in steps or steps[name].isna().all()]
    if missing:
        raise ConfigurationError(
            f"video: the steps lack {', '.join(missing)}; films know drives and flights only"
        )


def _gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Return an animated GIF that starts again, its last picture held for a while."""
    whole = [Image.fromarray(picture) for picture in pictures]
    palette = _palette(np.concatenate([whole[k] for k in (0, len(whole) // 2, -1)]))
    few = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in whole]
    durations = [1000 // RATE] * (len(few) - 1) + [LAST]
    buffer = io.BytesIO()
    rest = {"append_images": few[1:], "duration": durations, "loop": 0}
    few[0].save(buffer, "GIF", save_all=True, optimize=True, **rest)
    return buffer.getvalue()


def _palette(picture: np.ndarray) -> Image.Image:
    """Return the most common colours, no two all but alike, so that areas keep theirs exactly."""
    image = Image.fromarray(picture)
    counted: Any = image.getcolors(image.width * image.height)
    common: dict[tuple[int, ...], tuple[int, ...]] = {}
    for _, colour in sorted(counted, reverse=True):
        common.setdefault(tuple(value // 8 for value in colour), colour)
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for colour in [*common.values()][:COLOURS] for value in colour])
    return palette


def _mp4(pictures: Iterable[np.ndarray]) -> bytes:
    """Return a film in H.264."""
    from imageio.v3 import imwrite  # an extra

    whole = np.stack(list(pictures))
    return imwrite("<bytes>", whole, extension=".mp4", plugin="FFMPEG", fps=RATE)


ENCODERS: dict[str, Callable[[Iterable[np.ndarray]], bytes]] = {"gif": _gif, "mp4": _mp4}
