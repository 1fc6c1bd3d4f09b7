"""What other tools take of a calibration, by the names that their documentation has."""

import ast
import json
import re

import numpy as np
import pytest
import yaml

from afm_rl.diagnosis import Log, calibrate
from afm_rl.diagnosis.tools import TOOLS, answer
from afm_rl.errors import ConfigurationError

STEP, DELAY = 0.02, 3


@pytest.fixture(scope="module")
def calibration():
    """A reversed axis with an offset, late by three steps, and a healthy one; one rests."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, (300, 3)), 3, axis=0) * [1, 1, 0]
    y = np.roll(u, DELAY, axis=0) * [-0.5, 1, 1] + [0.2, 0, 0]
    y += 0.002 * rng.standard_normal(y.shape)
    names = ("vx", "wz", "arm")
    return calibrate(Log(names, u[DELAY:], y[DELAY:], t=STEP * np.arange(len(u) - DELAY)))


def arguments(line):
    """Return the keyword arguments of a line of Python."""
    call = ast.parse(f"Cfg({line})", mode="eval").body
    return {word.arg: ast.literal_eval(word.value) for word in call.keywords}


@pytest.mark.parametrize(
    ("tool", "joints", "low", "high"),
    [
        ("mjlab", "target_names_expr", "delay_min_lag", "delay_max_lag"),
        ("isaaclab", "joint_names_expr", "min_delay", "max_delay"),
    ],
)
def test_simulators_draw_delays_from_the_interval(calibration, tool, joints, low, high):
    found = [arguments(line) for line in answer(tool, calibration, step=STEP / 4).lines]
    assert {name for line in found for name in line[joints]} == {"vx", "wz"}
    for line in found:
        assert set(line) == {joints, low, high}
        assert 4 * DELAY - 2 <= line[low] <= 4 * DELAY <= line[high] <= 4 * DELAY + 2


def test_wheels_act_on_all_axes():
    u = np.random.default_rng(0).uniform(-1, 1, (300, 2))
    wheels = Log(("left", "right"), u[2:], u[:-2], t=0.1 * np.arange(298))
    found = yaml.safe_load("\n".join(answer("nav2", calibrate(wheels)).lines))
    axes = ("model_delay_vx", "model_delay_vy", "model_delay_wz")
    assert found == pytest.approx(dict.fromkeys(axes, 0.2), abs=0.01)


def test_motors_turn_the_other_way_and_begin_elsewhere(calibration):
    lines = "".join(answer("lerobot", calibration, tick=0.01).lines)
    assert json.loads("{" + lines.rstrip(",") + "}") == {
        "vx": {"drive_mode": 1, "homing_offset": 20},
        "wz": {"drive_mode": 0, "homing_offset": 0},
    }


def test_a_simulated_actuator_does_what_was_measured(calibration):
    mujoco = pytest.importorskip("mujoco")
    lines = answer("mujoco", calibration, step=STEP / 4).lines
    part = '<body><joint name="{}" type="slide"/><geom size=".1"/></body>'
    body = part.format("vx") + part.format("wz")
    actuators = "".join(re.sub(r'name="(\w+)"', r'name="\1" joint="\1"', line) for line in lines)
    text = f'<mujoco><option timestep="{STEP / 4}"/><worldbody>{body}</worldbody><actuator>'
    model = mujoco.MjModel.from_xml_string(f"{text}{actuators}</actuator></mujoco>")
    data, forces = mujoco.MjData(model), []
    for step in range(40):
        data.ctrl[:] = 0.4 * (step >= 10)
        mujoco.mj_step(model, data)
        forces.append(data.qfrc_actuator.copy())
    begins = 10 + 4 * DELAY
    np.testing.assert_allclose(forces[begins - 3], [0.2, 0.0], atol=0.01)
    np.testing.assert_allclose(forces[begins + 3], [0.2 - 0.5 * 0.4, 0.4], atol=0.01)


def test_what_a_tool_cannot_express_is_said(calibration):
    told = answer("mjlab", calibration, step=0.005).remarks
    assert told[0] == "mjlab has no field for: sign (vx -1), scale (vx 0.5), offset (vx 0.2)"
    assert told[-1] == "no lines for: cannot tell (arm)"
    assert not any("no field" in remark for remark in answer("mujoco", calibration, 0.005).remarks)


@pytest.mark.parametrize("tool", [tool for tool, about in TOOLS.items() if about.option])
def test_a_tool_asks_for_its_unit(calibration, tool):
    words = f"--for {tool}: expected --{TOOLS[tool].option}, "
    with pytest.raises(ConfigurationError, match=words):
        answer(tool, calibration)


def test_delays_in_rows_are_no_seconds():
    u = np.random.default_rng(0).uniform(-1, 1, (60, 1))
    with pytest.raises(ConfigurationError, match=r"expected a column t \(s\)"):
        answer("nav2", calibrate(Log(("wz",), u, u)))
