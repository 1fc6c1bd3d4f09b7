"""Film policies that others trained, without and with AFM, while their actuators fail.

    python benchmarks/suites/zoo/film.py --out docs/images/policies.gif

Above is a typical recovery, below a failure: the robot falls with AFM, too. The film shows MuJoCo's
capsules from the side, so it needs no graphics card. Episodes continue after a fall. The title of a
panel states robot, method, time and fault.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from methods import method_of
from task import POLICIES, Task

from afm_rl import FaultVectorWrapper
from afm_rl.comparison.episodes import corrected
from afm_rl.film import ENCODERS, picture, segments
from afm_rl.method_colours import colour_of
from afm_rl.report import style
from afm_rl.storage.files import write_whole

METHODS = ("without AFM", "AFM")
SCENES = {
    "half_cheetah_tqc": ("all reversed", "typical: with AFM it keeps running"),
    "hopper_trpo": ("reversed and late 2", "a failure: with AFM it falls, too"),
}
VIEW = 4.0, 2.2  # width and height of a panel, m
AFTER_A_FALL = {"hopper_trpo": {"terminate_when_unhealthy": False}}


def record(task: Task, fault: str, method: str, at: int, steps: int) -> np.ndarray:
    """Return the ends of all capsules, x and z, ``(T, G, 2, 2)``, at every step."""
    robot, chosen = method_of(method, task, fault)
    inner = FaultVectorWrapper(robot.vector(1), task.faults[fault], at)
    envs, act = corrected(robot, inner, task.begin([0]), chosen)
    world = inner.env.envs[0].unwrapped
    observations, _ = envs.reset(seed=[0])
    states = []
    for _ in range(steps):
        states.append(world.data.qpos.copy())
        observations, *_ = envs.step(act(observations, {}))
    envs.close()
    return segments(world.model, np.array(states))[0][..., ::2]


def draw(axes: Axes, ends: np.ndarray, sizes: np.ndarray, colour: str) -> None:
    """Draw a robot, and the ground in strips of half a metre."""
    axes.clear()
    axes.set_axis_off()
    left, width = ends[0, :, 0].mean() - VIEW[0] / 2, VIEW[0]
    axes.set(xlim=(left, left + width), ylim=(-0.15, VIEW[1] - 0.15))
    points = 72 * axes.get_window_extent().width / axes.figure.dpi / width
    for x in np.arange(np.floor(left), left + width, 1.0):
        axes.fill_between([x, x + 0.5], -0.15, 0.0, color=style.ROAD, lw=0)
    axes.axhline(0.0, color=style.FAINT, lw=0.8)
    for (x, z), radius in zip(ends.swapaxes(1, 2), sizes, strict=True):
        axes.plot(x, z, color=colour, lw=2 * radius * points, solid_capstyle="round")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/policies.gif"))
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rate", type=int, default=15, help="frames a second")
    args = parser.parse_args()
    torch.set_num_threads(1)
    figure = style.new_figure(6.4, 4.2)
    panels = figure.subplots(2, 2)
    rows = []
    for name, (fault, caption) in SCENES.items():
        task = Task(POLICIES / f"{name}.safetensors", **AFTER_A_FALL.get(name, {}))
        rate = task.robot.first.metadata["render_fps"]
        steps, at = round(args.seconds * rate), round(args.seconds * rate / 4)
        sizes = task.robot.first.unwrapped.model.geom_size[1:, 0]
        both = [record(task, fault, method, at, steps) for method in METHODS]
        robot = name.split("_t")[0].replace("_", " ")
        rows.append((robot, fault, caption, rate, at, sizes, both))

    def pictures():
        for frame in range(round(args.seconds * args.rate)):
            for row, (robot, fault, caption, rate, at, sizes, both) in zip(
                panels, rows, strict=True
            ):
                step = round(frame * rate / args.rate)
                state = f"{frame / args.rate:.1f} s: {fault if step >= at else 'no fault'}"
                for axes, method, film in zip(row, METHODS, both, strict=True):
                    draw(axes, film[step], sizes, colour_of(method))
                    axes.set_title(f"{robot}, {method}\n{state}", fontsize=style.NORMAL)
                row[0].text(0.0, -0.12, caption, transform=row[0].transAxes, fontsize=style.LARGE)
            yield picture(figure)

    write_whole(args.out, ENCODERS["gif"](pictures()))
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
