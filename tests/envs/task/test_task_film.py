"""Pictures of MuJoCo robots."""

from unittest.mock import MagicMock

import numpy as np
import pandas as pd
import pytest

from afm_rl.envs import TaskEnv, gymnasium_task
from afm_rl.film import BONE, SIZE, body_pictures, bones, can_render, segments

HEIGHT, WIDTH = SIZE

mujoco = pytest.importorskip("mujoco")
MODEL = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size=".02"/><geom size=".1" pos="0 0 -1"/></body>
</worldbody></mujoco>"""


@pytest.fixture
def pole():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture
def blind(monkeypatch):
    """A computer on which nothing can render; returns how often that was tried."""
    tries = []

    def fail(*args):
        tries.append(args)
        raise RuntimeError("no OpenGL")

    can_render.cache_clear()
    monkeypatch.setattr(mujoco, "Renderer", fail)
    yield tries
    can_render.cache_clear()


def test_bones_are_where_the_body_is(pole):
    ends, radii = segments(pole, np.array([[0.0], [-np.pi / 2]]))
    hanging, lying = (sorted(map(tuple, part.round(6) + 0.0)) for part in ends[:, 0])
    assert hanging == [(0, 0, 0), (0, 0, 1)]
    assert lying == [(0, 0, 1), (1, 0, 1)]
    np.testing.assert_allclose(ends[1, 1].mean(0), [1, 0, 1], atol=1e-6)
    assert radii.tolist() == [0.02, 0.1]


def test_bodies_without_a_shape_are_joined_by_bones():
    box = '<geom type="box" size=".02 .3 .1"/>'
    legs = f'<body pos="0 0 -.3"><body pos="0 .1 -.2"><body>{box}</body></body></body>'
    mjcf = f"<mujoco><worldbody><body pos='0 0 1'>{box}{legs}</body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(mjcf)
    assert bones(model).tolist() == [[1, 2], [2, 3]]  # the last one is where its parent is
    (ends,), radii = segments(model, np.zeros((1, 0)))
    np.testing.assert_allclose(ends[0], [[0, -0.2, 1], [0, 0.2, 1]])  # along the longest side
    np.testing.assert_allclose(ends[2:], [[[0, 0, 1], [0, 0, 0.7]], [[0, 0, 0.7], [0, 0.1, 0.5]]])
    assert radii.tolist() == [0.1, 0.1, BONE, BONE]


def test_where_nothing_can_render_bones_are_drawn(pole, blind):
    pictures = np.stack(list(body_pictures(pole, np.array([[0.0], [0.0], [0.5]]))))
    assert pictures.shape == (3, HEIGHT, WIDTH, 3)
    assert (pictures[0] == pictures[1]).all()
    assert (pictures[0] != pictures[2]).any()
    inside = (pictures[0] == (0, 114, 178)).all(-1)
    assert 500 < inside.sum() < HEIGHT * WIDTH / 4
    (_,) = body_pictures(pole, np.zeros((1, 1)))
    assert len(blind) == 1  # a second failure may kill


def test_mujocos_renderer_is_used_where_there_is_one(pole, monkeypatch):
    drawn, renderer = [], MagicMock()
    inside = renderer.return_value.__enter__.return_value
    inside.update_scene = lambda data, camera: drawn.append((float(data.qpos[0]), camera))
    monkeypatch.setattr(mujoco, "Renderer", renderer)
    can_render.cache_clear()
    pictures = list(body_pictures(pole, np.array([[0.1], [0.2]])))
    assert pictures == 2 * [inside.render.return_value] and drawn == [(0.1, -1), (0.2, -1)]
    assert renderer.return_value.__exit__.called
    can_render.cache_clear()


def test_a_task_draws_the_steps_of_a_mission(blind):
    task = gymnasium_task("InvertedPendulum-v5")
    steps = pd.DataFrame(np.zeros((2, 4)), columns=task.state_names)
    assert len(list(TaskEnv(task).draw(steps))) == 2


def test_a_state_without_a_body_is_drawn_as_curves_that_grow():
    task = gymnasium_task("Pendulum-v1")
    steps = pd.DataFrame({"t": [0, 5, 10], "angle": [0.0, 1.0, 0.0], "speed": [1.0, 0.0, -1.0]})
    pictures = np.stack(list(TaskEnv(task).draw(steps)))
    assert pictures.shape == (3, HEIGHT, WIDTH, 3)
    drawn = (np.abs(pictures.astype(int) - (0, 114, 178)).max(-1) < 60).sum((1, 2))
    assert drawn[0] < 20 < drawn[1] < drawn[2]


def test_a_ball_is_drawn(blind):
    ball = "<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody>"
    model = mujoco.MjModel.from_xml_string(f"{ball}</mujoco>")
    (picture,) = body_pictures(model, np.zeros((1, 1)))
    assert (picture == (0, 114, 178)).all(-1).sum() > 500
