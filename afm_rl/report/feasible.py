r"""The idea of the paper in one picture (section IV).

A changed robot does not leave the world that its base model :math:`f_0` knows: where the
transition that follows the planned action is one that :math:`f_0` can produce with *another*
action of the box, the change can be told, and undone, in terms of actions alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.report import style
from afm_rl.report.explain import Box, explain

SAMPLES = 1500
CLOSE = 1e-4  # m, rad: a displacement that another action explains to here is feasible
PLANNED = (0.4, -0.4)  # of the box's half-range: where the planned action lies
GAINS: dict[str, Sequence[float]] = {
    "gains -1, -1": (-1.0, -1.0),
    "gains 2, 2": (2.0, 2.0),
    "gains 0.1, -1.5": (0.1, -1.5),
    "gains -0.5, 1": (-0.5, 1.0),
}
RING: dict[str, Any] = {"marker": "o", "color": "none", "markeredgecolor": "black"}
RING |= {"markersize": 11, "markeredgewidth": 1.6}
CAPTION = (
    "Feasible dynamics. Left: actions; right: one-step displacements of the base model. Grey dots "
    "are samples from the state-action box; the shaded area is what the model can do from one "
    "state with actions of the box. The ring is the planned action and what the model expects of "
    "it. A changed robot moves otherwise (filled marks, right); the same mark on the left is the "
    "action with which the unchanged model would have done the same. Both lie inside: a "
    "misaligned transition is still a transition of the base model, under another action, which "
    "is what action flow matching learns to find. Gains are those of v and omega. The legend says "
    "which share of all planned actions of the box this holds for: gains above 1 carry large "
    "actions out of it, and what lies outside can be approached only."
)


class Axis(NamedTuple):
    """What one axis of the picture shows: a component, and its name."""

    component: int
    label: str


ACTION = (Axis(0, "v (m/s)"), Axis(1, "omega (rad/s)"))
DISPLACEMENT = (Axis(0, "displacement in x (m)"), Axis(2, "turn (rad)"))


@torch.no_grad()
def draw_feasible(
    model: DynamicsModel,
    state_box: Box,
    action_box: Box,
    gains: Mapping[str, Sequence[float]] = GAINS,
) -> Figure:
    """Return a picture of what a base model can do, and of where changed robots move within it.

    The axes are those of the ground robot: v and omega; displacement in x, and turn, seen
    from the middle of the state box.

    Args:
        model: base model of the nominal robot.
        state_box: lowest and highest state to sample from, ``(S,)`` each.
        action_box: lowest and highest action, ``(A,)`` each.
        gains: the changed robots to show: what multiplies each action axis, by name.

    Raises:
        ConfigurationError: if a box, or the gains of a robot, do not fit the model.
    """
    states = _sample("state_box", state_box, model.state_size)
    actions = _sample("action_box", action_box, model.action_size)
    low, high = action_box
    middle = (state_box[0] + state_box[1]).to(actions) / 2
    planned = (low + high) / 2 + (high - low) / 2 * torch.tensor(PLANNED)
    figure = style.new_figure(8.2, 4.4)
    left, right = figure.subplots(1, 2)
    _scene(left, actions, actions, ACTION)
    here = _displacement(model, middle.expand_as(states), actions)
    _scene(right, _displacement(model, states, actions), here, DISPLACEMENT)
    expected = _displacement(model, middle, planned)
    for axes, point, shown in ((left, planned, ACTION), (right, expected, DISPLACEMENT)):
        axes.plot(*_place(point, shown), **RING, zorder=5, gid="planned")
    handles = [Line2D([], [], linestyle="", **RING)]
    labels = ["planned action, and what the base model expects of it"]
    for (name, factors), look in zip(
        gains.items(), style.method_styles(gains).values(), strict=True
    ):
        if len(factors) != model.action_size:
            raise ConfigurationError(
                f"gains: {name}: {len(factors)} values, expected {model.action_size}, one for "
                "each action axis"
            )
        gain = torch.tensor(factors)
        moved = _displacement(model, middle, gain * planned)
        instead, _ = explain(model, middle, moved, action_box)
        changes = _displacement(model, states, gain * actions)
        _, rest = explain(model, states, changes, action_box)
        share = float((rest < CLOSE).float().mean())
        mark: dict[str, Any] = {
            "marker": look.marker,
            "color": look.color,
            "markeredgecolor": "white",
        }
        pairs = ((left, planned, instead, ACTION), (right, expected, moved, DISPLACEMENT))
        for axes, start, end, shown in pairs:
            arrow = {"arrowstyle": "-|>", "color": look.color, "shrinkA": 6, "shrinkB": 5}
            axes.annotate("", _place(end, shown), _place(start, shown), arrowprops=arrow, zorder=4)
            axes.plot(*_place(end, shown), **mark, markersize=9, zorder=6, gid="instead")
        handles.append(Line2D([], [], linestyle="", **mark, markersize=9))
        labels.append(f"{name}: {100 * share:.0f} % of planned actions feasible")
    style.legend_above(figure, handles, labels)
    return figure


def _displacement(model: DynamicsModel, state: Tensor, action: Tensor) -> Tensor:
    return model.manifold.difference(model(state, action), state)


def _sample(name: str, box: Box, size: int) -> Tensor:
    """Return points ``(N, size)`` that fill a box evenly, its corners among them."""
    low, high = box
    if low.shape != (size,) or high.shape != (size,) or bool((low > high).any()):
        raise ConfigurationError(
            f"{name}={low.tolist()}, {high.tolist()}: expected two rows of {size} numbers, the "
            "lowest values first"
        )
    corners = torch.cartesian_prod(*torch.tensor([[0.0, 1.0]] * size))
    points = torch.quasirandom.SobolEngine(size).draw(SAMPLES - len(corners))
    return low + (high - low) * torch.cat([corners, points]).to(low)


def _place(point: Tensor, shown: tuple[Axis, Axis]) -> tuple[float, float]:
    return float(point[shown[0].component]), float(point[shown[1].component])


def _scene(axes: Axes, cloud: Tensor, area: Tensor, shown: tuple[Axis, Axis]) -> None:
    """Draw samples as dots, and the convex hull of an area's samples."""
    components = [axis.component for axis in shown]
    points = area[:, components].numpy()
    hull = points[ConvexHull(points).vertices]
    axes.add_patch(Polygon(hull, facecolor="#dcebf5", edgecolor=style.FAINT, zorder=0, gid="area"))
    axes.plot(*cloud[:, components].numpy().T, ".", color="#a0a0a0", markersize=1.6, gid="cloud")
    axes.margins(0.08)
    axes.set_xlabel(shown[0].label, fontsize=style.NORMAL)
    axes.set_ylabel(shown[1].label, fontsize=style.NORMAL)
    style.dress(axes)
