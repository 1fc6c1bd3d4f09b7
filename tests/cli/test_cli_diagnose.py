"""The command ``afm-rl-diagnose``."""

import functools
import json
import re
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pandas as pd
import pytest
import torch
from puck import Puck, push

from afm_rl import ActionFlowWrapper, FaultWrapper
from afm_rl.cli import diagnose
from afm_rl.diagnosis import Actuator, read_calibration
from afm_rl.diagnosis.calibration import JointCalibration
from afm_rl.diagnosis.findings import STATUSES
from afm_rl.diagnosis.log import Log
from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.missions.explained import explain_mission
from afm_rl.spaces.manifold import Manifold


@pytest.fixture
def call(called):
    return functools.partial(called, diagnose.main, "afm-rl-diagnose")


@pytest.fixture
def log(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (400, 2))
    y = np.column_stack([u[:, 0], -0.62 * np.roll(u[:, 1], 2)])
    y += 0.01 * rng.standard_normal(u.shape)
    columns = {"t": 0.02 * np.arange(400)}
    columns |= {f"command.{name}": u[:, j] for j, name in enumerate(("pan", "<b>elbow"))}
    columns |= {f"response.{name}": y[:, j] for j, name in enumerate(("pan", "<b>elbow"))}
    pd.DataFrame(columns)[2:].to_csv(tmp_path / "log.csv", index=False)
    return tmp_path / "log.csv"


def test_a_log_becomes_a_table_a_file_and_a_page(call, log):
    done = call(log)
    assert (done.status, done.err) == (0, "")
    assert "pan: healthy" in done.out.splitlines()
    assert "<b>elbow: reversed, 62 % of the command, 2 steps (0.04 s) late" in done.out.splitlines()
    out = Path("outputs", "log_diagnosis")
    assert {path.name for path in log.parent.iterdir()} == {"here", "log.csv"}  # as it was
    pan, elbow = json.loads((out / "diagnosis.json").read_text())["actuators"]
    assert pan["status"] == "healthy" and pan["saturation"] is None
    assert elbow["gain_interval"][0] < elbow["gain"] < elbow["gain_interval"][1] < 0
    assert elbow["reversed"] and elbow["delay_s"] == pytest.approx(0.04, abs=0.002)
    page = (out / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "&lt;b&gt;elbow: reversed" in page
    assert "<b>" not in page and "http" not in page.replace("http-equiv", "")


def test_many_actuators_take_a_time_that_is_said_before(capsys):
    u = np.random.default_rng(0).uniform(-1, 1, (60, 4))
    many = Log(tuple("abcd"), u, u + 0.01 * np.random.default_rng(1).standard_normal(u.shape))
    diagnose._say_duration(many)
    assert capsys.readouterr().err == ""  # four are no matter
    diagnose._say_duration(many, many=3, few=2, noticed=0.0)
    assert re.fullmatch(r"4 actuators, 60 rows: at least \d+ s\n", capsys.readouterr().err)


def test_without_a_time_there_are_no_seconds(call, log):
    pd.read_csv(log).drop(columns="t").to_csv(log, index=False)
    done = call(log)
    assert "delay (rows)" in done.out and "(s)" not in done.out
    page = Path("outputs", "log_diagnosis", "index.html").read_text()
    assert "delay (rows)" in page and "(s)" not in page and " s," not in page


SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"


def test_files_for_programs_are_as_their_schemas_say(call, log):
    done = call(log, "--calibration", "arm.json", "--no-page")
    assert done.status == 0 and "wrote arm.json" in done.out
    files = {"diagnosis": "outputs/log_diagnosis/diagnosis.json", "calibration": "arm.json"}
    for name, file in files.items():
        schema = json.loads((SCHEMAS / f"{name}.json").read_text())
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(json.loads(Path(file).read_text()), schema)
    pan, elbow = read_calibration("arm.json").joints
    assert pan.undo == "u" and elbow.delay.value == pytest.approx(0.04, abs=0.002)
    assert elbow.sign.value == -1 and elbow.scale.value == pytest.approx(0.62, abs=0.01)


def test_schemas_name_what_there_is():
    actuator, joint = (
        json.loads((SCHEMAS / f"{name}.json").read_text())["$defs"][part]
        for name, part in (("diagnosis", "actuator"), ("calibration", "joint"))
    )
    for part in (actuator, joint):
        assert tuple(part["properties"]["status"]["enum"]) == STATUSES
    assert {*actuator["properties"]} <= {field.name for field in fields(Actuator)} | {"saturation"}
    assert {*joint["properties"]} == {field.name for field in fields(JointCalibration)}


@pytest.mark.parametrize(
    ("statuses", "status"),
    [("changed,dead", 1), ("dead", 0), ("cannot-tell, not measured", 0), ("healthy", 1), ("", 0)],
)
def test_the_exit_status_is_for_programs(call, log, statuses, status):
    done = call(log, "--fail-on", statuses, "--no-page")
    assert done.status == status and "wrote outputs" in done.out
    name = "pan" if statuses == "healthy" else "<b>elbow"
    assert done.err == (f"afm-rl-diagnose: --fail-on: {name}\n" if status else "")


def test_where_to_and_what_is_healthy(call, log, tmp_path):
    done = call(log, "--out", tmp_path / "there", "--delay", 0.04, "--no-page")
    assert "<b>elbow: reversed, 62 % of the command" in done.out.splitlines()
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["diagnosis.json"]


def test_lines_for_another_tool(call, log):
    done = call(log, "--for", "mjlab", "--step", 0.005, "--no-page")
    assert "delay_min_lag=" in done.out and done.err == ""
    assert "mjlab has no field for: sign (<b>elbow -1), scale (<b>elbow 0.62)" in done.out


def test_effective_actions_of_a_model(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "def step(state, action):\n    return 0.9 * state + 0.1 * action\n"
    (tmp_path / "own_model.py").write_text(text)
    rng = np.random.default_rng(0)
    actions, states = rng.uniform(-1, 1, (300, 2)), np.zeros((300, 2))
    for k in range(299):
        states[k + 1] = 0.9 * states[k] + 0.1 * actions[k] * [1, -0.5]
    columns = {f"action.{j}": actions[:, j] for j in range(2)}
    columns |= {f"state.{j}": states[:, j] for j in range(2)}
    pd.DataFrame(columns).to_csv("log.csv", index=False)
    refused = call("log.csv", "--model", "own_model.step")
    assert refused.status == 2 and refused.err.count("\n") == 1 and "own_model" not in sys.modules
    assert "function of a package that you trust: --trust own_model" in refused.err
    done = call("log.csv", "--model", "own_model.step", "--trust", "own_model")
    assert done.err == ""
    assert done.out.splitlines()[-4:-2] == ["0: healthy", "1: reversed, 50 % of the command"]
    told = done.out.splitlines()[:2]
    assert told[0].startswith("The model predicts only 5")
    cause = "Likely cause: the robot acts on -0.5 times 1 (signs, gains or units)"
    assert told[1].startswith(cause)
    assert json.loads(Path("outputs/log_diagnosis/diagnosis.json").read_text())["notes"][:2] == told


CART = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="rail" type="slide"
axis="1 0 0" damping="1"/><geom size=".1"/><body><joint name="pole" axis="0 1 0" damping=".1"/><geom
size=".05" pos="0 0 .5"/></body></body></worldbody><actuator><motor name="push" joint="rail"
gear="20"/></actuator></mujoco>"""


@pytest.fixture
def cart(tmp_path, monkeypatch):
    """A simulated robot's log of 150 rows, five steps of the simulation each; and its model."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart.xml").write_text(CART)
    robot, rng = MuJoCoDynamics(CART, frame_skip=5), np.random.default_rng(0)
    states = [torch.tensor([0.0, 0.3, 0.0, 0.0])]
    actions = torch.tensor(rng.uniform(-1, 1, (150, 1)))
    for action in actions[:-1]:
        states.append(robot(states[-1], action))
    names = {f"state.{name}": k for k, name in enumerate(robot.names[0])}
    table = {name: torch.stack(states).numpy()[:, k] for name, k in reversed(names.items())}
    table |= {"t": 0.05 * np.arange(150), "action.push": actions[:, 0].numpy()}
    pd.DataFrame(table | {"state.more": 0.0}).to_csv("cart.csv", index=False)
    return table


def test_columns_are_those_that_a_simulator_names(call, cart):
    done = call("cart.csv", "--model", "cart.xml")
    assert (done.status, done.err) == (0, "")
    first = done.out.splitlines()[0]
    assert first.startswith("The model is right: it predicts 100 % of the motion (")
    assert {f"{name} 100 %" for name in ("q_pole", "v_rail")} < set(re.split(r"[(,;] ?", first))
    assert "push: healthy" in done.out.splitlines()


def test_missing_columns_are_named(call, cart):
    renamed = pd.DataFrame(cart).rename(columns={"state.q_pole": "state.angle"})
    renamed.to_csv("log.csv", index=False)
    refused = call("log.csv", "--model", "cart.xml")
    assert refused.status == 2 and refused.out == "" and refused.err.count("\n") == 1
    assert "no column state.q_pole for the model, but state.v_pole, " in refused.err
    assert "--response q_pole=COLUMN" in refused.err
    names = "q_pole=state.angle,q_rail=state.q_rail,v_rail=state.v_rail,v_pole=state.v_pole"
    fields = ["--response", names, "--command", "push=action.push"]
    assert "The model is right" in call("log.csv", "--model", "cart.xml", *fields).out


def test_a_log_is_replayed(call, log, tmp_path):
    pd.read_csv(log)[:70].to_csv(log, index=False)
    done = call(log, "--replay", tmp_path / "out.csv")
    assert done.status == 0  # a slow machine shows its progress
    sentence = next(line for line in done.out.splitlines() if line.startswith("A correction"))
    assert sentence.endswith("% of the error of <b>elbow, and none of pan.")
    rows = pd.read_csv(tmp_path / "out.csv")
    assert len(rows) == 70 and np.isfinite(rows["afm.<b>elbow"]).all()
    again = call(tmp_path / "out.csv", "--no-page")  # a log like any other
    assert "pan: healthy" in again.out.splitlines() and again.err == ""
    page = Path("outputs/log_diagnosis/index.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "affine least squares" in page


def test_a_simulator_of_others_reads_its_own_folder(call, cart, tmp_path):
    for name in ("robot", "parts"):
        (tmp_path / name).mkdir()
    (tmp_path / "parts" / "plain.xml").write_text("<mujoco><size nkey='0'/></mujoco>")
    text = CART.replace("<mujoco>", "<mujoco><include file='../parts/plain.xml'/>")
    (tmp_path / "robot" / "cart.xml").write_text(text)
    done = call("cart.csv", "--model", "robot/cart.xml")
    assert (done.status, done.out) == (2, "") and done.err.count("\n") == 1
    assert "--model: may read" in done.err and f"--trust {tmp_path}/parts\n" in done.err
    done = call("cart.csv", "--model", "robot/cart.xml", "--trust", "parts")
    assert (done.status, done.err) == (0, "") and "The model is right" in done.out


def test_columns_that_no_model_can_take_are_listed(call, log):
    done = call(log, "--model", "cart.xml")
    assert done.status == 2 and "log.csv: columns t, command.pan" in done.err
    assert done.out.splitlines()[:2] == ["t", "command.pan"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["\x1b[31m.csv"], "?[31m.csv: no such file"),
        (["log.csv", "--episode", "run"], "log.csv: --episode run: there is no such name"),
        ([], "the following arguments are required: FILE"),
        (["log.csv", "--fail-on", "broken"], "--fail-on='broken': expected one of healthy, cha"),
        (["log.csv", "--for", "x"], "--for='x': expected one of mjlab, isaaclab, nav2, lerobot, m"),
        (["log.csv", "--for", "lerobot", "--tick", "0"], "--tick=0.0: expected a finite number"),
        (["log.csv", "--delay", "-1"], "--delay=-1.0: expected a finite number"),
        (["cart.csv", "--model", "no.xml"], "dynamics.model=no.xml: no such file"),
        (["cart.csv", "--model", "os.system"], "--model os.system: expected a file .xml, or a"),
        (["cart.csv", "--model", "step", "--trust", "step"], "--model step: expected a file .xml"),
        (["cart.csv", "--model", "no.step", "--trust", "no"], "--model='no.step': cannot be found"),
    ],
)
def test_mistakes_end_in_one_line(call, log, cart, monkeypatch, arguments, message):
    monkeypatch.chdir(log.parent)
    done = call(*arguments)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"afm-rl-diagnose: {message}") and done.err.count("\n") == 1


FAULTS = [({"gain_0": -1.0}, 0), ({"gain_1": 0.5}, 0), ({"gain_1": -0.6}, 61)]


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "at"), FAULTS, ids=["reversed", "half", "since a step"])
def test_one_drive_one_verdict(fault, at, call, tmp_path, monkeypatch):
    """The wrapper, the command, the page and the lines that close a mission say the same."""
    monkeypatch.chdir(tmp_path)
    drive = tmp_path / "drive.csv"
    wrapped = ActionFlowWrapper(FaultWrapper(Puck(), fault, at), push, record=drive)
    wrapped.reset(seed=0)
    for k in range(120):
        state, *_ = wrapped.step(np.sin([0.4 * k, 0.7 * k + 1]))
    words = [line.partition(": ")[2] for line in wrapped.diagnosis.splitlines()]
    assert words[:2] != ["healthy", "healthy"]
    printed = call("drive.csv", "--out", "out").out
    page = (tmp_path / "out" / "index.html").read_text()
    table = pd.read_csv(drive)
    table.loc[120] = [*table.iloc[-1][: -len(state)], *state]  # where it arrived
    names = [name.partition(".")[2] for name in table if name.startswith("executed_action.")]
    states = [name for name in table if name.startswith("state.")]
    model = KnownDynamics(push, Manifold(len(states)), len(names))
    robot = SimpleNamespace(model=model, dt=None, state_names=states, action_names=names)
    executed = {f"executed_action.{name}": f"executed_{name}" for name in names}
    closing, _ = explain_mission(robot, table.rename(columns=executed).assign(t=range(121)))
    for name, said, actuator in zip(names, words[:2], closing.actuators, strict=True):
        assert f"{name}: {said}" in printed and f"{name}: {said}" in page
        assert actuator.sentence == f"{name}: {said}"
