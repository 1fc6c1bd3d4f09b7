"""Logs as strangers write them: heads, times, commands and signs that are not the usual ones."""

import re

import numpy as np
import pandas as pd
import pytest
from harness import refused
from simulate import Fault, commands, log_of, respond, said, servo

from afm_rl.diagnosis import Log, diagnose
from afm_rl.diagnosis.readers import read_log

ROWS = 300


def late(u, rows):
    return np.concatenate([np.repeat(u[:1], rows, axis=0), u[: len(u) - rows]])


def table(seed=0, delay=5):
    """Return a log of two joints, of which the second is reversed, both late by the loop."""
    rng = np.random.default_rng(seed)
    u = commands(rng, ROWS, 2, "walk").round(5)
    y = (late(u, delay) * [1, -1] + 0.01 * rng.standard_normal(u.shape)).round(5)
    columns = {"t": 0.05 * np.arange(ROWS), "command.a": u[:, 0], "command.b": u[:, 1]}
    return pd.DataFrame(columns | {"response.a": y[:, 0], "response.b": y[:, 1]})


def write(path, rows, head):
    lines = [head, *(",".join(f"{cell:.5f}" for cell in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@refused(
    (lambda rows: np.insert(rows, 1, 0.0, axis=1), "row 1 has 6 cells, the header 5 names"),
    (lambda rows: [*rows[:7], [*rows[7], 1.0], *rows[8:]], "row 8 has 6 cells, the header 5"),
)
def test_rows_longer_than_the_head_line(spoil, tmp_path):
    read_log(write(tmp_path / "log.csv", spoil(table().to_numpy()), ",".join(table())))


def test_an_empty_cell_at_the_end_is_no_cell(tmp_path):
    path = write(tmp_path / "log.csv", table().to_numpy(), ",".join(table()))
    head, _, rows = path.read_text().partition("\n")
    path.write_text(head + "\n" + rows.replace("\n", ",\n"))
    assert len(read_log(path)) == ROWS


@pytest.mark.parametrize("order", [slice(None), [1, 2, 3, 4, 0]])
def test_the_head_of_savetxt(tmp_path, order):
    columns = list(np.array(list(table()))[order])
    path = tmp_path / "log.csv"
    np.savetxt(path, table()[columns], "%.5f", ",", header=",".join(columns))
    log = read_log(path)
    assert log.names == ("a", "b") and log.step == pytest.approx(0.05)
    found = diagnose(log)
    assert [a.sentence for a in found.actuators] == ["a: healthy", "b: reversed"]
    assert "a delay of 5 steps (0.25 s)" in found.common[0]


def test_whole_seconds_and_a_pause(tmp_path):
    rng = np.random.default_rng(0)
    u = commands(rng, 1200, 1, "steps")
    y = late(u, 6) + 0.01 * rng.standard_normal(u.shape)
    second = 1741685120 + np.arange(1200) // 20 + 3600 * (np.arange(1200) >= 600)
    columns = {"Time": second, "command.a": u[:, 0], "response.a": y[:, 0]}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    log = read_log(tmp_path / "log.csv")
    assert log.begins.sum() == 2 and log.step == pytest.approx(0.05)
    assert said(log) == ["6 steps (0.3 s) late"]
    assert log.notes[1] == "Time has 1 pause: a new stretch of rows begins after each"


@refused(
    ("log.csv", "0.1,0.2\n0.2,0.3\n", "numbers only: expected a header"),
    ("log.h5", "", "with h5py"),
    ("flight.bin", "", "mavlogdump.py"),
    ("flight.BBL", "", "blackbox_decode"),
    ("log.mat", "", "scipy.io.loadmat"),
    ("log.npz", "", "numpy.savetxt"),
    ("log.xlsx", "", "save the sheet as CSV"),
    ("log.pkl", "", "runs code"),
)
def test_other_files_name_what_to_do(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    read_log(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("top", [1.0, 0.5])
def test_commands_beyond_the_range_of_a_controller(top):
    u = 7.5 * commands(0, 800, 2, "walk")
    for sentence in said(log_of(u, servo(np.clip(u, -top, top), 99.0, 0, 0.5), scale=0.004)):
        words = r"no more for commands beyond ([\d.]+) \(\d+ % of the range\).*"
        found = re.fullmatch(words, sentence)
        assert found and float(found[1]) == pytest.approx(top, rel=0.02), sentence


@pytest.mark.parametrize(("sign", "side"), [(1, "negative"), (-1, "positive")])
def test_a_sign_that_depends_on_another_command(sign, side):
    u = commands(0, 800, 3, "walk")
    y = u.copy()
    y[:, 1] *= sign * np.where(u[:, 0] < 0, -1, 1)
    found = said(log_of(u, late(y, 2), ("throttle", "steering", "flaps"), t=0.05 * np.arange(800)))
    words = f"reversed while the command of throttle is {side}"
    assert found == ["healthy", words, "healthy"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walk", "white"])
@pytest.mark.parametrize(("rows", "delay"), [(300, 0), (300, 3), (600, 3)])
def test_a_sign_that_changes_at_the_very_end(kind, rows, delay):
    u = commands(1, rows, 2, kind)
    y, since = late(u, delay), rows - rows // 20
    y[since:, 0] *= -1
    flipped, healthy = diagnose(log_of(u, y)).actuators
    sentence = flipped.sentence
    assert re.match(r"joint_0: (.* late, )?reversed.* since step", sentence), sentence
    assert flipped.changes[-1].t == pytest.approx(since, abs=4)
    assert not healthy.changes


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_responses_that_rest_in_a_part_raise_no_warning():
    u = commands(0, 400, 1, "steps")
    y = np.where(np.arange(400)[:, None] < 200, u, 0.0)
    (actuator,) = diagnose(Log(("a",), u, y)).actuators
    assert actuator.status in ("dead", "cannot tell")


@pytest.mark.parametrize("lag", [0, 3])
@pytest.mark.parametrize("other", ["smooth", "none"])
def test_two_publishers_of_one_topic(lag, other):
    rng = np.random.default_rng(0)
    one = commands(rng, 600, 1, "smooth")
    two = commands(rng, 600, 1, other) if other != "none" else np.zeros((600, 1))
    u = np.where(np.arange(600)[:, None] % 2 == 0, one, two)
    (both,) = said(log_of(u, respond(u, Fault(lag=1), 0)))
    assert "cannot tell" not in both
    (first,) = said(log_of(u, respond(one, Fault(lag=lag), 0)))
    assert "cannot tell: its command alternates between two series" in first


def test_a_mirrored_axis_has_the_mirrored_verdict():
    u = commands(0, 900, 3, "walk")
    y = np.column_stack([u[:, 0] + 0.3, np.where(u[:, 1] > 0, 1, 0.5) * u[:, 1], u[:, 2]])
    shift, halves, healthy = said(log_of(-u, -y))
    assert re.fullmatch(r"offset -0\.(3|29\d|30\d) .*", shift)
    assert halves == "50 % of positive commands, 100 % of negative ones"
    assert healthy == "healthy"
