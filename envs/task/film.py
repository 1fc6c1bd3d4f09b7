"""Pictures of MuJoCo robots, by its renderer or as bones, and of any state as curves."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

SIZE = 480, 640  # height and width of MuJoCo's own buffer, pixels
PLANE, CAPSULE, CYLINDER = 0, 3, 5  # MuJoCo's numbers of kinds of geoms
BODY, FIXED = "#0072b2", "#999999"


def film(model: Any, states: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a picture ``(H, W, 3)`` of each state (qpos, ...) of an ``MjModel``, ``(T, S)``."""
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
    moving = np.array([model.body_weldid[body] > 0 for body in model.geom_bodyid])[_solid(model)]
    own = ends[:, moving] if moving.any() else ends
    spread = np.ptp(own.reshape(-1, 3), axis=0)
    across = [0, 2] if spread[2] > spread[1] else [0, 1]
    size = 1.5 * np.ptp(own[..., across], axis=(1, 2)).max() + 4 * float(wide.max()) + 1e-3
    middle = own[..., across].mean((1, 2))
    if np.ptp(middle, axis=0).max() < size:  # it stays: so does the picture
        box = own[..., across].reshape(-1, 2)
        middle = np.repeat((box.min(0) + box.max(0))[None] / 2, len(states), 0)
        size = max(size, 1.2 * np.ptp(box, axis=0).max())
    figure = _sheet()
    canvas = FigureCanvasAgg(figure)
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
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def segments(model: Any, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ends (m) of the axes of geoms, ``(T, K, 2, 3)``, and their radii (m), ``(K,)``.

    Planes are left out; geoms that are not long have both ends near the middle: a line without any
    length would not be drawn.
    """
    import mujoco

    data, solid = mujoco.MjData(model), _solid(model)
    long = np.isin(model.geom_type[solid], (CAPSULE, CYLINDER))
    half = np.where(long, model.geom_size[solid, 1], 0.05 * model.geom_size[solid, 0])[:, None]
    ends = []
    for row in states:
        data.qpos = row[: model.nq]
        mujoco.mj_kinematics(model, data)
        axis = half * data.geom_xmat[solid].reshape(-1, 3, 3)[..., 2]
        ends.append(np.stack([data.geom_xpos[solid] - axis, data.geom_xpos[solid] + axis], 1))
    return np.stack(ends), model.geom_size[solid, 0]


def curves(t: np.ndarray, states: np.ndarray, names: Sequence[str]) -> Iterator[np.ndarray]:
    """Yield pictures of curves that grow, one panel per coordinate of states ``(T, S)``."""
    figure = _sheet(layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    lines = []
    for panel, name, column in zip(panels, names, states.T, strict=True):
        panel.plot(t, column, color=FIXED, alpha=0.3, linewidth=1)
        panel.set_ylabel(name)
        lines.append(panel.plot([], color=BODY)[0])
    panels[-1].set_xlabel("step")
    for end in range(1, len(states) + 1):
        for line, column in zip(lines, states.T, strict=True):
            line.set_data(t[:end], column[:end])
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _sheet(dpi: int = 80, **look: Any) -> Figure:
    height, width = SIZE
    return Figure(figsize=(width / dpi, height / dpi), dpi=dpi, **look)


def _solid(model: Any) -> np.ndarray:
    return np.flatnonzero(model.geom_type != PLANE)
