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
from afm_rl.report.learning import last_step
from afm_rl.report.runs import Runs, steps_of
from afm_rl.report.scenes import COLUMNS, Scene, map_scene, space_scene
from afm_rl.report.style import FEW
from afm_rl.report.trajectory import DrawableTrack
from afm_rl.report.write import folder_names
from afm_rl.storage.files import write_whole

FRAMES, RATE = 150, 15  # at most; per second
LAST = 1500  # ms, how long the last frame of a GIF stays
Draw = Callable[[pd.DataFrame], Iterable[np.ndarray]]


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
    runs: Runs,
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
        runs: the results; see :data:`~.scenes.COLUMNS` for what their steps must have.
        tracks: tracks to draw, found by name.
        form: ``"gif"`` or ``"mp4"``.
        echo: receives one line per film.
        draw: returns pictures of a mission's steps, for robots that are not on a map.

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
    steps, roads = runs.steps(first), {track.name: track for track in tracks}
    rows = steps_of(steps, first["mission"])
    space = {"z", "goal_z"} <= set(steps.dropna(axis=1, how="all"))
    together, *names = folder_names(["all_methods", *first["method"]])
    written: list[Path] = []

    def write(name: str, pictures: Iterable[np.ndarray]) -> None:
        written.append(folder / f"{name}.{form}")
        write_whole(written[-1], ENCODERS[form](pictures))
        echo(f"wrote {written[-1]}")

    cell = first["cell"].iloc[0]
    beside = first[first["cell"] == cell][:FEW]
    if draw is None and len(beside) > 1 and not space:
        end = last_step(beside)
        parts = {m.method: _checked(rows, m.mission, steps) for m in beside.itertuples()}
        parts = {name: own[own["t"] <= end] for name, own in parts.items()}
        scene = map_scene(cell, parts, roads.get(beside["track"].iloc[0]))
        write(together, frames(scene, max(map(len, parts.values()))))
    for mission, name in zip(first.itertuples(), names, strict=True):
        if draw is not None:
            own = rows[mission.mission]
            write(name, draw(own.iloc[_shown(len(own))]))
            continue
        own, title = _checked(rows, mission.mission, steps), f"{mission.method}: {mission.cell}"
        road = roads.get(mission.track)
        scene = space_scene(title, own) if space else map_scene(title, {mission.method: own}, road)
        write(name, frames(scene, len(own)))
    return written


def frames(scene: Scene, count: int, dpi: int = 100) -> Iterator[np.ndarray]:
    """Yield the pictures ``(height, width, 3)`` of a mission of ``count`` steps.

    What does not move is drawn once; the rest is drawn over it.
    """
    figure, canvas = scene.figure, cast(FigureCanvasAgg, scene.figure.canvas)
    figure.set_dpi(dpi)
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


def _palette(picture: np.ndarray, colours: int = 128) -> Image.Image:
    """Return the most common colours, no two almost alike, so that areas keep theirs exactly."""
    packed = picture.astype(np.int64) @ [65536, 256, 1]  # far faster than unique rows
    values, counts = np.unique(packed, return_counts=True)
    common = values[np.argsort(-counts, kind="stable"), None] // [65536, 256, 1] % 256
    _, first = np.unique(common // 8, axis=0, return_index=True)
    palette = Image.new("P", (1, 1))
    palette.putpalette([int(value) for value in common[np.sort(first)[:colours]].ravel()])
    return palette


def _mp4(pictures: Iterable[np.ndarray]) -> bytes:
    """Return a film in H.264."""
    from imageio.v3 import imwrite  # an extra

    whole = np.stack(list(pictures))
    return imwrite("<bytes>", whole, extension=".mp4", plugin="FFMPEG", fps=RATE)


ENCODERS: dict[str, Callable[[Iterable[np.ndarray]], bytes]] = {"gif": _gif, "mp4": _mp4}
