"""Damaged and malicious logs end in one line, whatever they hold."""

import json
import os
import random
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mcap.writer import Writer

from afm_rl.diagnosis.readers import read_log
from afm_rl.errors import ConfigurationError

LOGS = Path(__file__).parents[2] / "examples" / "real_logs"
ULOG = (["vehicle_rates_setpoint.roll"], ["vehicle_attitude.rollspeed"])


def mcap_file(folder):
    """Return an MCAP file of 60 rows."""
    with (folder / "log.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=500)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channel = writer.register_channel("/arm", "json", schema)
        for k, u in enumerate(np.random.default_rng(0).uniform(-1, 1, 60)):
            data = json.dumps({"u": u, "y": [u, 0]}).encode()
            writer.add_message(channel, 10**7 * k, data, 10**7 * k)
        writer.finish()
    return folder / "log.mcap"


def data_set(folder):
    shutil.copytree(LOGS / "unitree_g1", folder / "g1")
    return folder / "g1"


def mutated(data, rng):
    """Return bytes of which some are changed, cut out, put in, or filled with ones."""
    found, place = bytearray(data), rng.randrange(len(data))
    if rng.random() < 0.3:  # what is where is often written at the end
        place = max(0, len(data) - rng.randint(1, 300))
    noise = rng.randbytes(rng.randint(1, 16))
    match rng.randrange(5):
        case 0:
            found[place : place + len(noise)] = noise
        case 1:
            del found[place:]
        case 2:
            del found[place : place + rng.randint(1, 64)]
        case 3:
            found[place:place] = noise
        case 4:
            found[place : place + 8] = b"\xff" * 8
    return bytes(found)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("make", "inside", "names", "count"),
    [
        (lambda folder: LOGS / "warthog_ice.csv", "", (), 200),
        (lambda folder: LOGS / "crazyflie_ramp.parquet", "", (), 150),
        (lambda folder: LOGS / "warthog_ice_wheels.parquet", "", (), 150),
        (data_set, "meta/info.json", (), 150),
        (data_set, "data/chunk-000/episode_000002.parquet", (), 100),
        (lambda folder: LOGS / "px4_disarmed.ulg", "", ULOG, 100),
        (mcap_file, "", (["/arm.u"], ["/arm.y[0]"]), 150),
    ],
)
def test_a_thousand_mutations(tmp_path, make, inside, names, count):
    rng, whole, read = random.Random(0), make(tmp_path), 0
    data = (whole / inside).read_bytes() if inside else whole.read_bytes()
    path = whole if inside else tmp_path / f"mutated{whole.suffix}"
    for _ in range(count):
        (path / inside if inside else path).write_bytes(mutated(data, rng))
        try:
            log = read_log(path, *names)
        except ConfigurationError as error:
            assert str(error).isprintable() and str(error).startswith(str(path))
        else:
            read += 1
            assert np.isfinite(log.command).all() and np.isfinite(log.response).all()
            assert all(name.isprintable() for name in log.names)
    assert read < count


@pytest.mark.parametrize(
    "name", ["log.csv", "log.parquet", "log.ulg", "log.mcap", "meta/info.json"]
)
def test_pipes_and_devices_are_not_opened(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(path)
        with pytest.raises(ConfigurationError, match="no regular file"):
            read_log(tmp_path if "/" in name else path)
        path.unlink()
    path.symlink_to(path.name)  # to itself
    with pytest.raises(ConfigurationError, match="expected"):
        read_log(tmp_path if "/" in name else path)


def test_pipes_in_a_data_set_are_skipped(tmp_path):
    folder = data_set(tmp_path)
    os.mkfifo(folder / "data" / "chunk-000" / "episode_000009.parquet")
    (folder / "data" / "chunk-000" / "episode_000008.parquet").symlink_to("/dev/zero")
    log = read_log(folder)
    assert log.begins.sum() == 2 and log.notes == (
        "skipped, no regular file: episode_000008.parquet, episode_000009.parquet",
    )


def test_a_stated_shape_is_not_believed(tmp_path):
    folder = data_set(tmp_path)
    info = json.loads((folder / "meta" / "info.json").read_text())
    for feature in info["features"].values():
        feature |= {"shape": [1e9], "names": None}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    assert read_log(folder).names[:2] == ("0", "1")


def test_a_bag_of_something_else(tmp_path):
    with sqlite3.connect(tmp_path / "log.db3") as file:
        file.execute("create table messages (x)")
    with pytest.raises(ConfigurationError, match="no bag of ROS, or a damaged one"):
        read_log(tmp_path / "log.db3", ["a"], ["b"])


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("1e31", r"command.a: row 7: expected numbers below 1e\+30"),
        ("\x1b[2J", r"command.a: .* in row 7: expected a number"),
    ],
)
def test_numbers_that_no_robot_has(tmp_path, cell, message):
    rows = [[0.1 * k, 0.5, 0.4] for k in range(30)]
    rows[7][1] = cell
    head = ["t", "command.a", "response.a"]
    pd.DataFrame(rows, columns=head).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ConfigurationError, match=message) as error:
        read_log(tmp_path / "log.csv")
    assert str(error.value).isprintable() and len(str(error.value)) < 300


def test_an_integer_of_400_digits_is_no_number(tmp_path):
    rows = "".join(f"{400 * '1' if k == 7 else k},{k}\n" for k in range(30))
    (tmp_path / "log.csv").write_text("command.a,response.a\n" + rows)
    log = read_log(tmp_path / "log.csv")
    assert len(log.command) == 29 and "1 of 30 rows were dropped" in log.notes[0]


def test_names_do_not_reach_the_terminal_as_they_are(tmp_path):
    u = np.random.default_rng(0).uniform(-1, 1, 30)
    table = pd.DataFrame({"command.\x1b[31mpan": u, "response.\x1b[31mpan": u})
    table.to_csv(tmp_path / "log.csv", index=False)
    assert read_log(tmp_path / "log.csv").names == ("?[31mpan",)


def test_two_columns_of_one_name_are_refused(tmp_path):
    text = "command.a,command.a,response.a\n" + "1,2,3\n" * 30
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ConfigurationError, match=r"command\.a: two columns of this name"):
        read_log(tmp_path / "log.csv")
