"""Films: pictures of what moves, of MuJoCo's bodies and of curves, and how they are written."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from afm_rl.errors import ConfigurationError
from afm_rl.imports import needs

FRAMES, RATE = 150, 15  # at most; per second
SIZE = 480, 640  # height and width of MuJoCo's own buffer, pixels
BODY, FIXED = "#0072b2", "#999999"
BONE = 0.015  # m, radius
BAND = 48  # pixels, the height of a caption: a multiple of 16, as video codecs want it
Moves = dict[Artist, Callable[[int], object]]


class Scene(NamedTuple):
    """A figure whose moving parts can be set to any step."""

    figure: Figure
    moving: Moves
    """All that differs from frame to frame, in the order of drawing, and what sets it to a row of
    the table of steps, or of the longest of several."""

    def show(self, row: int) -> None:
        """Set all moving parts to a row."""
        for move in self.moving.values():
            move(row)


def sheet(width: float = 8.0, height: float = 6.0, dpi: float = 80, **look: Any) -> Figure:
    """Return an empty figure of so many inches, which needs no window; if not said, of SIZE."""
    figure = Figure((width, height), dpi=dpi, **look)
    FigureCanvasAgg(figure)
    return figure


def trail(line: Any, *columns: np.ndarray, longest: int = 10**9) -> Callable[[int], object]:
    """Return what draws a line, in a plane or in space, up to a row of its columns ``(T,)``.

    Args:
        line: of matplotlib.
        columns: x, y and, in space, z.
        longest: rows that are drawn at most, the last ones.

    >>> from matplotlib.lines import Line2D
    >>> line = Line2D([], [])
    >>> trail(line, np.arange(9), np.arange(9) ** 2, longest=2)(3)
    >>> line.get_ydata().tolist()
    [4, 9]
    """
    put = line.set_data if len(columns) == 2 else line.set_data_3d
    return lambda row: put(*(column[max(row + 1 - longest, 0) : row + 1] for column in columns))


def shown(count: int) -> np.ndarray:
    """Return which of so many steps are shown.

    >>> shown(3).tolist(), len(shown(4000))
    ([0, 1, 2], 150)
    """
    return np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int))


def frames(scene: Scene, rows: Iterable[int]) -> Iterator[np.ndarray]:
    """Yield the pictures ``(height, width, 3)`` of a scene at some rows.

    What does not move is drawn once; the rest is drawn over it.
    """
    figure, canvas = scene.figure, cast(FigureCanvasAgg, scene.figure.canvas)
    scene.show(0)  # texts take the room that they need
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for artist in scene.moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for row in rows:
        canvas.restore_region(background)
        scene.show(int(row))
        for artist in scene.moving:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def picture(figure: Figure) -> np.ndarray:
    """Return a figure as it is now, ``(height, width, 3)`` bytes."""
    canvas = cast(FigureCanvasAgg, figure.canvas)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def captioned(pictures: Iterable[np.ndarray], captions: Iterable[str]) -> Iterator[np.ndarray]:
    """Yield pictures ``(H, W, 3)`` below a band with their captions, ``(BAND + H, W, 3)``.

    Args:
        pictures: of bytes.
        captions: one for each picture, of at most two lines.

    >>> (shown,) = captioned([np.zeros((16, 64, 3), np.uint8)], ["arm"])
    >>> shown.shape, int(shown[0].min()), int(shown[:BAND].min()) < 50
    ((64, 64, 3), 255, True)
    """
    font = ImageFont.truetype(findfont("DejaVu Sans"), 15)
    for pixels, caption in zip(pictures, captions, strict=True):
        band = Image.new("RGB", (pixels.shape[1], BAND), "white")
        ImageDraw.Draw(band).multiline_text((8, 5), caption, fill="black", font=font)
        yield np.concatenate([np.asarray(band), pixels])


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
    if video == "mp4":
        needs("video=mp4", "imageio_ffmpeg", "video")
    return video


def _gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Return an animated GIF that starts again, its last picture held for a while."""
    whole = [Image.fromarray(picture) for picture in pictures]
    palette = _palette(np.concatenate([whole[k] for k in (0, len(whole) // 2, -1)]))
    few = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in whole]
    durations = [1000 // RATE] * (len(few) - 1) + [1500]  # ms, how long the last one stays
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

    film = np.stack([*pictures])
    return imwrite("<bytes>", film, extension=".mp4", plugin="FFMPEG", fps=RATE)


ENCODERS: dict[str, Callable[[Iterable[np.ndarray]], bytes]] = {"gif": _gif, "mp4": _mp4}


def body_pictures(model: Any, states: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a picture ``(H, W, 3)`` of each state (qpos, ...) of an ``MjModel``, ``(T, S)``.

    By MuJoCo's renderer, or, where nothing can render, as bones.
    """
    import mujoco

    if not can_render():
        yield from _bones(model, states)
        return
    data, camera = mujoco.MjData(model), 0 if model.ncam else -1
    with mujoco.Renderer(model, *SIZE) as renderer:
        for row in states:
            data.qpos = row[: model.nq]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            yield renderer.render()


@cache
def can_render() -> bool:
    """Tell whether MuJoCo can draw here; tried once, as a second failure may end the process."""
    import mujoco

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 1, 1).close()
    except Exception:  # each platform fails in its own way
        return False
    return True


def _bones(model: Any, states: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pictures of the axes of capsules and the middles of other geoms."""
    ends, wide = segments(model, states)  # (T, K, 2, 3), (K,)
    moving = np.append(model.body_weldid[model.geom_bodyid[solid(model)]], bones(model)[:, 1]) > 0
    drawn = ends[:, moving] if moving.any() else ends
    spread = np.ptp(drawn.reshape(-1, 3), axis=0)
    across = [0, 2] if spread[2] > spread[1] else [0, 1]
    size = 1.5 * np.ptp(drawn[..., across], axis=(1, 2)).max() + 4 * float(wide.max()) + 1e-3
    middle = drawn[..., across].mean((1, 2))
    if np.ptp(middle, axis=0).max() < size:  # it stays: so does the picture
        box = drawn[..., across].reshape(-1, 2)
        middle = np.repeat((box.min(0) + box.max(0))[None] / 2, len(states), 0)
        size = max(size, 1.2 * np.ptp(box, axis=0).max())
    figure = sheet()
    axes = figure.add_axes((0.1, 0.1, 0.85, 0.85), aspect="equal")
    axes.set(xlabel="xyz"[across[0]] + " (m)", ylabel="xyz"[across[1]] + " (m)")
    points = 72 * 0.85 * figure.get_figheight() / size  # of a metre
    look = {"capstyle": "round", "linewidths": np.maximum(2 * wide * points, 2.0)}
    colours = [BODY if moves else FIXED for moves in moving]
    lines: Any = axes.add_collection(LineCollection([], colors=colours, **look))
    for now, (x, y) in zip(ends[..., across], middle, strict=True):
        lines.set_segments(list(now))
        wider = size * SIZE[1] / SIZE[0] / 2
        axes.set(xlim=(x - wider, x + wider), ylim=(y - size / 2, y + size / 2))
        yield picture(figure)


def segments(model: Any, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ends (m) of the axes of geoms and of :func:`bones`, ``(T, K, 2, 3)``, and radii (m).

    Planes are left out; geoms that are not long have both ends near the middle: a line without any
    length would not be drawn.
    """
    import mujoco

    data, geoms = mujoco.MjData(model), solid(model)
    kind, size = model.geom_type[geoms], model.geom_size[geoms]
    boxes, long = np.isin(kind, (4, 6, 7)), np.isin(kind, (3, 5))  # ellipsoids, meshes; capsules
    radius = np.where(boxes, np.median(size, 1), size[:, 0])
    half = np.where(boxes, np.maximum(size.max(1) - radius, 0.05 * radius), 0.05 * radius)
    half = np.where(long, size[:, 1], half)[:, None]
    which, along = np.arange(len(geoms)), np.where(boxes, size.argmax(1), 2)
    pairs, ends = bones(model), []
    for row in states:
        data.qpos = row[: model.nq]
        mujoco.mj_kinematics(model, data)
        axis = half * data.geom_xmat[geoms].reshape(-1, 3, 3)[which, :, along]
        both = np.stack([data.geom_xpos[geoms] - axis, data.geom_xpos[geoms] + axis], 1)
        ends.append(np.concatenate([both, data.xpos[pairs]]))
    return np.stack(ends), np.append(radius, [BONE] * len(pairs))


def bones(model: Any) -> np.ndarray:
    """Return the bodies (parent, child) ``(K, 2)`` of which one has no shape: to be joined.

    So a robot whose meshes are left out is seen as its skeleton.
    """
    shaped = np.isin(np.arange(model.nbody), model.geom_bodyid[solid(model)])
    parents = model.body_parentid
    length = np.linalg.norm(model.body_pos, axis=1)
    pairs = [
        (parents[child], child)
        for child in range(1, model.nbody)
        if parents[child] and length[child] > 0 and not (shaped[parents[child]] and shaped[child])
    ]
    return np.array(pairs, dtype=int).reshape(-1, 2)


def curves(t: np.ndarray, states: np.ndarray, names: Sequence[str]) -> Iterator[np.ndarray]:
    """Yield pictures of curves that grow, one panel per coordinate of states ``(T, S)``."""
    figure, moving = sheet(layout="constrained"), Moves()
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for panel, name, column in zip(panels, names, states.T, strict=True):
        panel.plot(t, column, color=FIXED, alpha=0.3, linewidth=1)
        panel.set_ylabel(name)
        (line,) = panel.plot([], color=BODY)
        moving[line] = trail(line, t, column)
    panels[-1].set_xlabel("step")
    return frames(Scene(figure, moving), range(len(states)))


def solid(model: Any) -> np.ndarray:
    """Return the numbers of an ``MjModel``'s geoms but planes."""
    return np.flatnonzero(model.geom_type != 0)
