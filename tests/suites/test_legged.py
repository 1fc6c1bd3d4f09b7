"""Robots of position servos and their policies, from a folder."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from harness import refused
from PIL import Image

from afm_rl.diagnosis import Log, diagnose
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Actuators, servo_faults

pytest.importorskip("mujoco")
pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")
BESIDE = ("zoo",)
OWN = Path(__file__).parents[2] / "benchmarks" / "suites" / "legged" / "robots"


@pytest.fixture
def small(suite):
    return suite("robot").Robot(OWN, "small")


def test_the_command_plays_and_goes_on(command, tmp_path):
    asked = ["--out", tmp_path, "--seeds", "1", "--steps", "60", "--faults"]
    said = command("run", *asked, "none", "all at half", "--methods", "alone", "truth")
    assert "small, alone: 2 episodes" in said and "| all at half | 0." in said
    more = ["--methods", "alone", "--figure", tmp_path / "figure.png"]
    assert "small, alone: 1 episodes" in command("run", *asked, "none", "late 1", *more)
    said = command("run", *asked, "late 1", "--methods", "alone", "--at", "20", "30")
    assert said.count("small, alone: 1 episodes") == 2 and "small, at 2 steps:" in said
    assert "small, 8 servos:" in command("run", *asked[:-1], "--each", "--methods", "truth")
    with Image.open(tmp_path / "figure.png") as figure:
        assert figure.width > 500


def test_the_film_shows_who_falls(command, tmp_path):
    words = ["--fault", "late 2", "--at", "0.1", "--seconds", "0.4", "--out", tmp_path / "film.gif"]
    assert "fell: []" in command("film", *words)
    with Image.open(tmp_path / "film.gif") as pictures:
        assert pictures.n_frames == 6


@pytest.mark.parametrize("fault", ["offset .1 on all", "all at half", "swapped pair"])
def test_with_the_truth_a_robot_walks_on(suite, small, fault):
    rewards_of, pairs = suite("episodes").rewards_of, [("none", 0), (fault, 0)]
    rewards, lasted = rewards_of(small, "truth", pairs, 140)
    healthy, corrected = -rewards[90:].mean(0)
    alone = -rewards_of(small, "alone", pairs[1:], 140)[0][90:].mean()
    assert (lasted == 140).all() and healthy < 0.15
    assert corrected < healthy + 0.05 and alone > corrected


def test_corrected_a_robot_of_servos_walks_on(suite, small):
    """The correction as it comes; two robots side by side, some seconds."""
    rewards_of = suite("episodes").rewards_of
    pairs = [("one reversed", 0), ("swapped pair", 0)]
    alone, corrected = (
        -rewards_of(small, method, pairs, 140)[0][90:].mean(0) for method in ("alone", "AFM")
    )
    assert (corrected < 0.6 * alone).all()


def test_a_diagnosis_of_servos_is_about_their_pose_in_their_unit():
    pose = torch.tensor([0.9, -1.8, 0.1, 0.9, 0.9, 0.4])
    named = servo_faults(6, one=3, other=4)
    fault = named["swapped pair"] | {"gain_0": -1.0, "gain_1": 0.5, "bias_2": 0.25}
    servos = Actuators([-3.0] * 6, [3.0] * 6, home=pose)
    servos.fail(fault)
    random = np.random.default_rng(0)
    commands = pose.numpy() + random.uniform(-0.3, 0.3, (40, 6))
    effects = np.stack([servos(torch.from_numpy(command)) for command in commands])
    said = str(diagnose(Log(tuple("abcdef"), commands, effects, computed=True))).splitlines()
    assert said[:2] == ["a: reversed about its middle (0.9)", "b: 50 % of the moves of its command"]
    assert said[2].startswith("c: offset +0.25 ") and said[3] == "d: follows the command of e"
    assert said[5] == "f: healthy"


def test_our_gait_is_the_one_that_is_written(command, tmp_path):
    command("write_gait", "--out", tmp_path / "policy.onnx")
    assert (tmp_path / "policy.onnx").read_bytes() == (OWN / "small_policy.onnx").read_bytes()


def described(folder, **changed):
    """Copy the small robot to a folder, with another description."""
    for file in OWN.glob("small*"):
        shutil.copy(file, folder)
    about = json.loads((OWN / "small.json").read_text()) | changed
    about = {name: value for name, value in about.items() if value is not None}
    (folder / "small.json").write_text(json.dumps(about))
    return folder


def test_an_observation_has_the_named_parts_in_order(suite, tmp_path):
    parts = [
        {"phases": [0.0, np.pi], "rate": 3.0},
        {"sensor": "gyro"},
        {"gravity": "imu"},
        {"positions": ["FL_knee"]},
        {"velocities": "all"},
        "action",
        "command",
    ]
    robot = suite("robot").Robot(OWN, "small")
    robot.parts = [robot._part(entry) for entry in parts]
    state = robot.twin.reset(seed=0)[0]
    seen = robot.seen(state, np.full(8, 7.0), seconds=0.04)
    angle = 3.0 * 2 * np.pi * 0.04
    phases = np.cos([angle, angle + np.pi]), np.sin([angle, angle + np.pi])
    expected = [*phases, np.zeros(3), [0, 0, -1], state[10:11] + 1, np.zeros(8), [7.0] * 8]
    assert np.allclose(seen, np.concatenate([*expected, [0.75, 0, 0]]))


@refused(
    ({"speed": None}, "speed: missing"),
    ({"observation": [{"smell": "imu"}]}, "expected sensor, gravity"),
    ({"observation": ["command"]}, "3 observations and 8 servos; its policy has 16 and 8"),
    ({"keyframe": "standing"}, "standing"),
    ({"failing": ["tail", "FL_hip"]}, "tail"),
    ({"frame": 0.0}, "frame"),
)
def test_what_a_description_lacks_is_said(changed, suite, tmp_path):
    suite("robot").Robot(described(tmp_path, **changed), "small")


def test_servos_with_several_inputs_are_refused(suite, tmp_path):
    file = described(tmp_path) / "small.xml"
    file.write_text(file.read_text().replace("<position name", '<pid kp="9" name', 1))
    with pytest.raises(ConfigurationError, match=r"small\.xml: expected position servos of one in"):
        suite("robot").Robot(tmp_path, "small")


def test_a_robot_without_description_is_refused(suite, tmp_path):
    with pytest.raises(ConfigurationError, match=r"mine\.json: no such file"):
        suite("robot").Robot(tmp_path, "mine")
    (tmp_path / "mine.json").write_text("[")
    with pytest.raises(ConfigurationError, match=r"mine\.json: expected an object of JSON"):
        suite("robot").Robot(tmp_path, "mine")
