"""Damaged and malicious logs end with a message of one line."""

import json
import os
import random
import shutil
import sqlite3
import struct
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as arrow
import pytest
from formats import LOGS, mcap_of
from harness import mutated
from mcap.writer import CompressionType
from pyarrow import parquet
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from afm_rl.diagnosis.readers import read_log
from afm_rl.errors import ConfigurationError

ULOG = (["vehicle_rates_setpoint.roll"], ["vehicle_attitude.rollspeed"])


def mcap_file(folder):
    """Return an MCAP file of 60 rows."""
    u = np.random.default_rng(0).uniform(-1, 1, 60)
    topic = "/arm", 0.0, 0.01, [{"u": x, "y": [x, 0]} for x in u]
    return mcap_of(folder / "log.mcap", topic, chunk_size=500)


def data_set(folder):
    shutil.copytree(LOGS / "unitree_g1", folder / "g1")
    return folder / "g1"


@pytest.mark.slow
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
    note = "skipped, no regular file: 2 of 4 files, episode_000008.parquet, episode_000009.parquet"
    assert log.begins.sum() == 2 and log.notes == (note,)


def test_a_stated_shape_is_not_believed(tmp_path):
    folder = data_set(tmp_path)
    info = json.loads((folder / "meta" / "info.json").read_text())
    for feature in info["features"].values():
        feature |= {"shape": [1e9], "names": None}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    assert read_log(folder).names[:2] == ("0", "1")


def test_an_integer_of_400_digits_is_no_number(tmp_path):
    cell_of(400 * "1")(tmp_path / "log.csv")
    log = read_log(tmp_path / "log.csv")
    assert len(log.command) == 29 and "1 of 30 rows were dropped" in log.notes[0]


def test_names_do_not_reach_the_terminal_as_they_are(tmp_path):
    u = np.random.default_rng(0).uniform(-1, 1, 30)
    table = pd.DataFrame({"command.\x1b[31mpan": u, "response.\x1b[31mpan": u})
    table.to_csv(tmp_path / "log.csv", index=False)
    assert read_log(tmp_path / "log.csv").names == ("?[31mpan",)


def lists_of(**lengths):
    """Write a table whose columns are lists of zeros, of given lengths."""

    def write(path):
        ends = {name: np.cumsum([0, *sizes]) for name, sizes in lengths.items()}
        make = arrow.LargeListArray.from_arrays
        columns = {name: make(end, np.zeros(end[-1])) for name, end in ends.items()}
        parquet.write_table(arrow.table(columns), path, compression="zstd")

    return write


def chunk_of(compression):
    topic = "/arm", 0.0, 0.0, [b'{"u": "' + b"x" * (1 << 25) + b'"}']
    return lambda path: mcap_of(path, topic, compression=compression)


def ulog_of(formats, topics=1):
    """Write a ULog of formats and subscriptions of the first, without data."""

    def write(path):
        head = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(8)
        parts = [struct.pack("<HB", len(each), ord("F")) + each for each in formats]
        name = formats[0].partition(b":")[0]
        for k in range(topics):
            parts.append(struct.pack("<HBBH", 3 + len(name), ord("A"), 0, k) + name)
        path.write_bytes(head + b"".join(parts))

    return write


def sparse(path):
    """Write 4 GiB of which most are no bytes on the disk, and no lines."""
    path.write_text("command.a,response.a\n" + "1,2\n" * 30)
    os.truncate(path, 1 << 32)


def tables_of(text):
    def write(path):
        with sqlite3.connect(path) as file:
            file.executescript(text)

    return write


VIEW = """
create table topics (id); create table messages (id);
create view schema (schema_version) as with recursive c (x) as
(select 1 union all select x + 1 from c) select max(x) from c
"""


def cell_of(text):
    rows = "".join(f"{text if k == 7 else 0.5},{k}\n" for k in range(30))
    return lambda path: path.write_text("command.a,response.a\n" + rows)


def text_of(text):
    return lambda path: path.write_text(text)


NESTED = [b"a:b[65535] x;", b"b:c[65535] x;", b"c:float[65535] x;"]
WIDE = [900] * 300
TWICE = "command.a,command.a,response.a\n" + "1,2,3\n" * 30


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("huge.csv", cell_of("1e31"), r"command.a: row 7: expected numbers below 1e\+30"),
        ("twice.csv", text_of(TWICE), r"command\.a: two columns of this name"),
        ("other.db3", tables_of("create table messages (x)"), "no bag of ROS, or a damaged one"),
        ("cell.parquet", lists_of(action=[5_000_000, *[1] * 29]), "action: 166,668 numbers a row"),
        ("wide.parquet", lists_of(action=WIDE, state=WIDE), "900 actuators: expected at most 256"),
        ("line.csv", sparse, "a line of more than 1,048,576 bytes: expected rows"),
        ("head.csv", text_of("c," * 2**19), "a line of more than 1,048,576 bytes: expected a head"),
        ("names.csv", text_of("c," * 200_000), "more than 100,000 columns"),
        ("zstd.mcap", chunk_of(CompressionType.ZSTD), "a chunk unpacks to more than"),
        ("lz4.mcap", chunk_of(CompressionType.LZ4), "a chunk unpacks to more than"),
        ("nested.ulg", ulog_of(NESTED), "topics of more than 100,000 fields"),
        ("many.ulg", ulog_of([b"a:float[999] x;"], 60_000), "topics of more than 100,000 fields"),
        ("view.db3", tables_of(VIEW), "view schema: expected only tables"),
    ],
)
def test_files_that_cannot_be_used_or_hold_much(tmp_path, name, write, message):
    """What a file unpacks to is known, or bounded, before it is unpacked."""
    write(tmp_path / name)
    fields = (["a"], ["b"]) if name.endswith(("mcap", "ulg", "db3")) else ()
    with pytest.raises(ConfigurationError, match=message) as error:
        read_log(tmp_path / name, *fields)
    said = str(error.value)
    assert said.isprintable() and said.startswith(str(tmp_path / name)) and len(said) < 400


def test_messages_may_have_many_numbers_of_which_some_are_named(tmp_path):
    topic = "/arm", 0.0, 0.01, [{f"k{k}": k for k in range(3000)}] * 30
    mcap_of(tmp_path / "log.mcap", topic)
    log = read_log(tmp_path / "log.mcap", ["/arm.k999"], ["/arm.k998"])
    assert log.command.tolist() == [[999.0]] * 30
    with pytest.raises(ConfigurationError, match="/arm.k1000: there is no such name"):
        read_log(tmp_path / "log.mcap", ["/arm.k1000"], ["/arm.k998"])


@pytest.mark.slow
def test_memory_is_bounded_where_nothing_else_is(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    text = store.types["std_msgs/msg/String"]("x" * (1 << 27))
    writer = BagWriter(tmp_path / "log.bag")
    writer.set_compression(BagWriter.CompressionFormat.BZ2)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=store)
        writer.write(connection, 0, store.serialize_ros1(text, "std_msgs/msg/String"))
    code = """
import resource, sys
from pathlib import Path
from afm_rl.diagnosis.readers import bounded_memory, read_log
before = resource.getrlimit(resource.RLIMIT_DATA)
try:
    with bounded_memory(Path(sys.argv[1]), least=1 << 26):
        read_log(sys.argv[1], ["a"], ["b"])
except ValueError as error:
    print(error)
assert resource.getrlimit(resource.RLIMIT_DATA) == before
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "log.bag"], capture_output=True)
    said = f"{tmp_path}/log.bag: not enough memory; log less at a time\n"
    assert (done.stdout.decode(), done.returncode) == (said, 0), done.stderr
