"""Draw what is believed of a half cheetah's motor that is reversed.

    python examples/explain_afm/belief.py --out docs/images/belief.png

The policy is one that others trained (``examples/policies/zoo``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes

from afm_rl.play import Side, make_robot
from afm_rl.report import style
from afm_rl.storage.files import write_whole

BEFORE = 40  # steps in which the robot gets going
NOW = {"healthy": {}, "reversed": {"gain_0": -1.0}}
LOOKS = {
    "planned": {"color": "#bbbbbb", "linewidth": 5.0},
    "executed": {"color": style.REGIME, "linewidth": 1.2},
    "effective": {"color": style.COLOURS[0], "linewidth": 1.6},
}


def act(steps: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return commands and beliefs of the first motor, ``(2 steps,)`` each."""
    side = Side(make_robot("half_cheetah"), corrected=True)
    for _ in range(BEFORE):
        side.step()
    commands, beliefs = [], []
    for fault in NOW.values():
        side.faulty.fail(fault)
        for _ in range(steps):
            side.step()
            commands.append(side.commands[-1][:, 0])
            beliefs.append({name: chance[0] for name, chance in side.info["afm"]["belief"].items()})
    names = sorted(beliefs[0], key=lambda name: -max(belief[name] for belief in beliefs))
    curves = {name: np.array([belief[name] for belief in beliefs]) for name in names[:2]}
    return dict(zip(LOOKS, np.array(commands).T, strict=True)), curves


def draw(axes: Axes, curves: dict[str, np.ndarray], y: str) -> None:
    """Draw curves, and their names above."""
    for (name, curve), style_of in zip(curves.items(), style.COLOURS, strict=False):
        look = LOOKS.get(name, {"color": style_of, "linewidth": 1.6})
        axes.plot(curve, label=name, **look)
    style.dress(axes, y=y, size=style.NORMAL)
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=9)


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/belief.png"))
    parser.add_argument("--steps", type=int, default=30, help="of each half")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    commands, beliefs = act(asked.steps)
    figure = style.new_figure(4.8, 3.6)
    above, below = figure.subplots(2, 1, sharex=True)
    draw(above, commands, "command")
    draw(below, beliefs, "probability")
    below.set_xlabel("step", fontsize=style.NORMAL)
    for axes in (above, below):
        axes.axvspan(asked.steps, 2 * asked.steps, color=style.BAND, alpha=0.15, lw=0)
        axes.set_xlim(0, 2 * asked.steps - 1)
    for k, name in enumerate(NOW):
        place = (k + 0.5) * asked.steps, 0.5
        below.annotate(name, place, ha="center", fontsize=style.NORMAL)
    write_whole(asked.out, style.png_bytes(figure))
    print(f"wrote {asked.out}")


if __name__ == "__main__":
    main()
