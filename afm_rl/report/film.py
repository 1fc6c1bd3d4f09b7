"""Films of missions, drawn from the table of steps."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from afm_rl.errors import ConfigurationError
from afm_rl.report.collect import collect
from afm_rl.report.events import folder_names
from afm_rl.report.frames import first_missions, steps_of
from afm_rl.report.learning import last_step
from afm_rl.report.results_files import read_steps
from afm_rl.report.scenes import COLUMNS, Scene, map_scene, space_scene
from afm_rl.report.style import FEW
from afm_rl.report.track_plot import DrawableTrack, LoadTrack, load_tracks
from afm_rl.storage.files import write_whole

FRAMES, RATE = 150, 15  # at most; per second
DPI, COLOURS = 100, 128
LAST = 1500  # ms, how long the last frame of a GIF stays
Draw = Callable[[pd.DataFrame], Iterable[np.ndarray]]
TOGETHER = "all_methods"  # file name


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
    draw: Draw | None = None,
) -> list[Path]:
    """Write a film of each method's first mission, ``METHOD.gif`` or ``METHOD.mp4``.

    Of several methods on a map, one more film shows all of them at once (``all_methods.gif``),
    six at most, until soon after the last one finished. A film has at most 150 frames, 15 a
    second, whatever the length of the mission. Files of the same name are replaced; each is
    written whole or not at all.

    Args:
        folder: where to; made if it is not there.
        missions: one row per mission.
        steps: one row per mission and step; see :data:`~.scenes.COLUMNS`.
        tracks: tracks to draw, found by name.
        form: ``"gif"`` or ``"mp4"``.
        echo: receives one line per film.
        draw: returns pictures of a mission's steps, for robots that are not on a map.

    Returns:
        The files written.

    Raises:
        ConfigurationError: if a column is missing, or the folder cannot be written.
    """
    roads = {track.name: track for track in tracks}
    first = first_missions(missions).drop_duplicates("method")
    rows = steps_of(steps, first["mission"])
    if draw is not None:
        names, written = folder_names([TOGETHER, *first["method"]])[1:], []
        for mission, name in zip(first.itertuples(), names, strict=True):
            own = rows[mission.mission]
            written.append(folder / f"{name}.{form}")
            write_whole(written[-1], ENCODERS[form](draw(own.iloc[_shown(len(own))])))
            echo(f"wrote {written[-1]}")
        return written
    space = {"z", "goal_z"} <= set(steps.dropna(axis=1, how="all"))
    written = []

    def write(name: str, scene: Scene, count: int) -> None:
        written.append(folder / f"{name}.{form}")
        write_whole(written[-1], ENCODERS[form](frames(scene, count)))
        echo(f"wrote {written[-1]}")

    cell = first["cell"].iloc[0]
    together = first[first["cell"] == cell][:FEW]
    if len(together) > 1 and not space:
        runs = {m.method: _checked(rows, m.mission, steps) for m in together.itertuples()}
        end = last_step(together)
        runs = {name: own[own["t"] <= end] for name, own in runs.items()}
        scene = map_scene(cell, runs, roads.get(together["track"].iloc[0]))
        write(TOGETHER, scene, max(map(len, runs.values())))
    names = folder_names([TOGETHER, *first["method"]])[1:]
    for mission, name in zip(first.itertuples(), names, strict=True):
        own, title = _checked(rows, mission.mission, steps), f"{mission.method}: {mission.cell}"
        if space:
            scene = space_scene(title, own)
        else:
            scene = map_scene(title, {mission.method: own}, roads.get(mission.track))
        write(name, scene, len(own))
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
        folders: of runs, comparisons, sweeps or studies.
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
    tracks = load_tracks(first["track"].unique(), load_track)
    return write_films(out, first, read_steps(collection.files, first), tracks, form, echo)


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
    for row in _shown(count):
        canvas.restore_region(background)
        scene.show(int(row))
        for artist in scene.moving:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _shown(count: int) -> np.ndarray:
    """Return which of so many steps are shown."""
    return np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int))


def _checked(rows: dict[int, pd.DataFrame], mission: int, steps: pd.DataFrame) -> pd.DataFrame:
    """Return the steps of a mission, if they can be filmed."""
    own = rows.get(mission, steps.iloc[:0])
    missing = [name for name in COLUMNS if name not in own or own[name].isna().all()]
    if missing:
        raise ConfigurationError(
            f"video: the steps lack {', '.join(missing)}; films are drawn of robots with positions"
        )
    return own


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
    """Return the most common colours, no two almost alike, so that areas keep theirs exactly."""
    packed = picture.astype(np.int64) @ [65536, 256, 1]  # far faster than unique rows
    values, counts = np.unique(packed, return_counts=True)
    common = values[np.argsort(-counts, kind="stable"), None] // [65536, 256, 1] % 256
    _, first = np.unique(common // 8, axis=0, return_index=True)
    palette = Image.new("P", (1, 1))
    palette.putpalette([int(value) for value in common[np.sort(first)[:COLOURS]].ravel()])
    return palette


def _mp4(pictures: Iterable[np.ndarray]) -> bytes:
    """Return a film in H.264."""
    from imageio.v3 import imwrite  # an extra

    whole = np.stack(list(pictures))
    return imwrite("<bytes>", whole, extension=".mp4", plugin="FFMPEG", fps=RATE)


ENCODERS: dict[str, Callable[[Iterable[np.ndarray]], bytes]] = {"gif": _gif, "mp4": _mp4}
