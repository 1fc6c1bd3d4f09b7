"""What a base model can do, and where changed robots move."""

import numpy as np
import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.report import draw_feasible
from afm_rl.report.explain import explain
from afm_rl.report.feasible import GAINS
from afm_rl.report.style import png_bytes

STATES = torch.tensor([0.0, 0.0, -torch.pi]), torch.tensor([0.0, 0.0, torch.pi])
ACTIONS = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])


def test_displacements_within_reach_are_explained_by_their_action():
    model, count = Dubins(), 50
    generator = torch.Generator().manual_seed(0)
    draw = 2 * torch.rand(count, 3, generator=generator) - 1
    state = draw * torch.tensor([5.0, 5.0, torch.pi])
    action = draw[:, :2] * ACTIONS[1]
    change = model.manifold.difference(model(state, action), state)
    found, rest = explain(model, state, change, ACTIONS)
    torch.testing.assert_close(found, action, atol=1e-5, rtol=0)
    assert rest.max() < 1e-5


def test_what_lies_outside_is_approached():
    change = torch.tensor([0.5, 0.0, 0.1])  # 2.5 m/s for 0.2 s
    action, rest = explain(Dubins(), torch.zeros(3), change, ACTIONS)
    torch.testing.assert_close(action, torch.tensor([1.0, 0.5]))
    assert float(rest) == pytest.approx(0.3, abs=1e-6)


def test_every_changed_robot_has_its_marks(artists):
    figure = draw_feasible(Dubins(), STATES, ACTIONS)
    left, right = figure.axes
    planned = artists(left, "planned")[0].get_xydata()[0]
    marks = [mark.get_xydata()[0] for mark in artists(left, "instead")]
    np.testing.assert_allclose(
        marks, [np.array(gains) * planned for gains in GAINS.values()], atol=1e-5
    )
    moved = [mark.get_xydata()[0] for mark in artists(right, "instead")]
    np.testing.assert_allclose(moved, 0.2 * np.array(marks), atol=1e-5)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "gains -1, -1: 100 % of planned actions feasible" in labels
    assert "gains 2, 2: 25 % of planned actions feasible" in labels
    png_bytes(figure)


def test_the_area_is_the_box(artists):
    left, _ = draw_feasible(Dubins(), STATES, ACTIONS).axes
    (area,) = artists(left, "area")
    corners = {tuple(np.round(corner, 6)) for corner in area.get_xy()}
    assert corners == {(-1.0, -1.5), (-1.0, 1.5), (1.0, -1.5), (1.0, 1.5)}


@pytest.mark.parametrize(
    ("states", "actions", "gains", "message"),
    [
        (STATES[::-1], ACTIONS, GAINS, "state_box=.*expected two rows of 3"),
        (STATES, STATES, GAINS, "action_box=.*expected two rows of 2"),
        (STATES, ACTIONS, {"odd": (1.0,)}, "gains: odd: 1 values, expected 2"),
    ],
)
def test_boxes_and_gains_must_fit(states, actions, gains, message):
    with pytest.raises(ConfigurationError, match=message):
        draw_feasible(Dubins(), states, actions, gains)
