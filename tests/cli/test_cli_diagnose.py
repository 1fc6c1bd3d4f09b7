"""The command ``afm-rl-diagnose``."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from afm_rl.cli import diagnose


@pytest.fixture
def call(monkeypatch, capsys):
    """Call the command; return status, output and errors."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["afm-rl-diagnose", *map(str, arguments)])
        try:
            diagnose.main()
            status = 0
        except SystemExit as ended:
            status = ended.code
        said = capsys.readouterr()
        return SimpleNamespace(status=status, out=said.out, err=said.err)

    return run


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


def test_where_to_and_what_is_healthy(call, log, tmp_path):
    done = call(log, "--out", tmp_path / "there", "--delay", 0.04, "--no-page")
    assert "<b>elbow: reversed, 62 % of the command" in done.out.splitlines()
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["diagnosis.json"]


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
    done = call("log.csv", "--model", "own_model.step")
    assert done.err == ""
    assert done.out.splitlines()[-4:-2] == ["0: healthy", "1: reversed, 50 % of the command"]
    sys.modules.pop("own_model")


def test_a_log_is_replayed(call, log, tmp_path):
    done = call(log, "--replay", tmp_path / "out.csv")
    assert done.status == 0  # a slow machine shows its progress
    sentence = next(line for line in done.out.splitlines() if line.startswith("A correction"))
    assert sentence.endswith("% of the error of <b>elbow, and none of pan.")
    rows = pd.read_csv(tmp_path / "out.csv")
    assert len(rows) == 398 and np.isfinite(rows["afm.<b>elbow"]).all()
    again = call(tmp_path / "out.csv", "--no-page")  # a log like any other
    assert "pan: healthy" in again.out.splitlines() and again.err == ""
    page = Path("outputs/log_diagnosis/index.html").read_text()
    assert page.count("data:image/png;base64,") == 3 and "affine least squares" in page


def test_what_is_in_a_log_of_messages_is_listed(call):
    ulog = Path(__file__).parents[2] / "examples" / "real_logs" / "px4_disarmed.ulg"
    done = call(ulog)
    assert done.status == 2 and done.err.count("\n") == 1 and "--command" in done.err
    assert "vehicle_rates_setpoint (184 messages): roll, pitch, yaw, thrust" in done.out


def test_fields_are_named(call, log, tmp_path):
    table = pd.read_csv(log).rename(columns=lambda name: name.replace(".", "_"))
    table.to_csv(tmp_path / "other.csv", index=False)
    pairs = ["--command", "joint=command_pan", "--response", "response_pan", "--no-page"]
    done = call(tmp_path / "other.csv", *pairs)
    assert done.err == "" and "joint: healthy" in done.out.splitlines()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["\x1b[31m.csv"], "?[31m.csv: no such file"),
        (["log.csv", "--episode", "run"], "log.csv: --episode run: there is no such name"),
        ([], "the following arguments are required: FILE"),
        (["nowhere.csv"], "nowhere.csv: no such file"),
        (["log.csv", "--delay", "-1"], "--delay=-1.0: expected a finite number"),
        (["log.csv", "--model", "no.step"], "log.csv: columns t, command.pan"),
    ],
)
def test_mistakes_end_in_one_line(call, log, monkeypatch, arguments, message):
    monkeypatch.chdir(log.parent)
    done = call(*arguments)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"afm-rl-diagnose: {message}") and done.err.count("\n") == 1


def test_the_help_teaches(call):
    done = call("--help")
    assert done.status == 0 and "command.NAME" in done.out
