"""Film a legged robot as its skeleton, without and with AFM, while a servo fails.

python benchmarks/suites/legged/film.py --robot FOLDER/g1 --out docs/images/g1.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes

from afm_rl.film import BONE, ENCODERS, RATE, picture, segments
from afm_rl.method_colours import colour_of
from afm_rl.play import World, make_robot
from afm_rl.report import style
from afm_rl.storage.files import write_whole

OWN = Path(__file__).parent / "robots" / "small"
TURN, TILT = np.deg2rad([50.0, 12.0])  # from behind, from above


def record(world: World, fault: str, steps: int, at: int) -> dict[str, np.ndarray]:
    """Return the positions of both robots at every step, ``(T, Q)``; after a fall they stay."""
    states: dict[str, list[np.ndarray]] = {name: [] for name in world.sides}
    for step in range(steps):
        if step == at:
            world.fail(world.robot.faults[fault])
        for name, side in world.sides.items():
            states[name].append(side.inner.data.qpos.copy())
            if not side.falls:
                side.step()
    return {name: np.array(rows) for name, rows in states.items()}


def seen(points: np.ndarray) -> np.ndarray:
    """Return the coordinates of points ``(..., 3)`` in the picture: x, y, depth."""
    x, y, z = np.moveaxis(points, -1, 0)
    across, ahead = np.sin(TURN) * x - np.cos(TURN) * y, np.cos(TURN) * x + np.sin(TURN) * y
    high, near = np.cos(TILT) * z + np.sin(TILT) * ahead, np.sin(TILT) * z - np.cos(TILT) * ahead
    return np.stack([across, high, near], -1)


def draw(axes: Axes, ends: np.ndarray, radii: np.ndarray, colour: str, tall: float) -> None:
    """Draw a robot, ends ``(K, 2, 3)``, on a ground of tiles of half a metre."""
    axes.clear()
    axes.set_axis_off()
    middle = ends.mean((0, 1)) * [1, 1, 0]
    centre = seen(middle)
    axes.set(
        xlim=centre[0] + np.array([-0.75, 0.75]) * tall,
        ylim=centre[1] + np.array([-0.3, 1.05]) * tall,
    )
    points = 72 * axes.get_window_extent().width / axes.figure.dpi / (1.5 * tall)
    first = np.floor(middle[:2] / (tall / 3))
    for tile in np.ndindex(9, 9):
        corner = (first + tile - 4) * tall / 3
        if (first + tile).sum() % 2 == 0:
            square = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * tall / 3
            axes.fill(*seen(np.c_[square, np.zeros(4)])[:, :2].T, color=style.ROAD, lw=0)
    shadow = seen(ends * [1, 1, 0])
    drawn = seen(ends)
    for (x, y, _), radius in zip(shadow.swapaxes(1, 2), radii, strict=True):
        axes.plot(x, y, color="0.78", lw=2 * radius * points, solid_capstyle="round")
    for part in drawn[..., 2].mean(1).argsort():
        x, y, _ = drawn[part].T
        width = 2 * radii[part] * points
        if radii[part] > BONE:
            axes.plot(x, y, color="white", lw=width + 1.2, solid_capstyle="round")
        axes.plot(x, y, color=colour, lw=width, solid_capstyle="round")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--robot", default=str(OWN), help="FOLDER/NAME; default: a small robot of this suite"
    )
    parser.add_argument("--fault", default="one reversed")
    parser.add_argument("--at", type=float, default=2.0, help="time of the fault, s")
    parser.add_argument("--seconds", type=float, default=7.0)
    parser.add_argument("--out", type=Path, default=Path("outputs/legged.gif"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    world = World(make_robot(args.robot))
    dt, name = world.robot.dt, world.robot.name.capitalize()
    steps, at = round(args.seconds / dt), round(args.at / dt)
    states = record(world, args.fault, steps, at)
    model = world.sides["with AFM"].inner.model
    both = {who: segments(model, rows) for who, rows in states.items()}
    lasted = {who: side.steps if side.falls else steps for who, side in world.sides.items()}
    tall = 1.1 * float(np.ptp(both["with AFM"][0][0, ..., 2]))
    figure = style.new_figure(6.4, 3.2, dpi=100)
    panels = figure.subplots(1, 2)

    def pictures():
        for frame in range(round(args.seconds * RATE)):
            step = min(round(frame / RATE / dt), steps - 1)
            for axes, (who, (ends, radii)) in zip(panels, both.items(), strict=True):
                draw(axes, ends[step], radii, colour_of(who), tall)
                state = args.fault if step >= at else "no fault"
                state += ", fell" if step >= lasted[who] else ""
                title = f"{name}, {who}\n{step * dt:.1f} s: {state}"
                axes.set_title(title, fontsize=style.LARGE)
            yield picture(figure)

    write_whole(args.out, ENCODERS["gif"](pictures()))
    print(f"wrote {args.out}; fell:", [who for who, side in world.sides.items() if side.falls])


if __name__ == "__main__":
    main()
