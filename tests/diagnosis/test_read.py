"""Logs from files, and what is said about those that cannot be used."""

import json

import numpy as np
import pandas as pd
import pytest
from formats import data_set_of
from harness import refused
from scipy.spatial.transform import Rotation

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import Unchosen, read_log


@pytest.fixture
def table():
    u = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    columns = {"t": 0.1 * np.arange(60), "command.a": u[:, 0], "command.b": u[:, 1]}
    return pd.DataFrame(columns | {"response.b": -u[:, 1], "response.a": u[:, 0]})


NAMES = ["pan.pos", "lift.pos"]


@pytest.fixture(params=["v2.1", "v3.0"])
def lerobot(tmp_path, request):
    """Two episodes as LeRobot writes them, a file each or in one; the second motor is reversed."""
    rng, episodes = np.random.default_rng(0), []
    for _ in range(2):
        u = rng.uniform(-1, 1, (100, 2)).astype(np.float32)
        y = np.concatenate([u[:1], u[:-1]]) * np.array([1, -1], dtype=np.float32)
        y += np.float32(1e-3) * rng.standard_normal(y.shape).astype(np.float32)
        episodes.append((u, y))
    names = {"v2.1": NAMES, "v3.0": {"lift.pos": 1, "pan.pos": 0}}[request.param]
    data_set_of(tmp_path, episodes, names, codebase_version=request.param)
    if request.param == "v3.0":
        files = sorted(tmp_path.glob("data/*/*"))
        pd.concat(map(pd.read_parquet, files)).to_parquet(files[0].with_name("file-000.parquet"))
        for file in files:
            file.unlink()
    return tmp_path


@pytest.mark.parametrize("suffix", ["csv", "tsv"])
@pytest.mark.parametrize(
    ("sep", "decimal"), [(",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ",")]
)
def test_tables(table, tmp_path, sep, decimal, suffix):
    path = tmp_path / f"log.{suffix}"
    table.to_csv(path, index=False, sep=sep, decimal=decimal)
    log = read_log(path)
    assert log.names == ("a", "b") and log.step == pytest.approx(0.1)
    np.testing.assert_allclose(log.response, log.command * [1, -1])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_row_per_message_is_filled_forward(tmp_path, seed):
    """As a flight log has two types of messages in one table, and a time of few digits."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-20, 20, (60, 2)), 4, axis=0)
    table = pd.DataFrame({"timestamp": 1.53e9}, index=range(480))
    for j, (name, sign) in enumerate((("roll", 1), ("pitch", -1))):
        table.loc[::2, f"NAV.nav_{name}"] = u[:, j]
        table.loc[1::2, f"ATTITUDE.{name}"] = sign * u[:, j] + 0.1 * rng.standard_normal(240)
    table.to_csv(tmp_path / "log.csv", index=False)
    log = read_log(tmp_path / "log.csv", ["NAV"], ["ATTITUDE"])
    assert str(diagnose(log)).splitlines()[:2] == ["nav_roll: healthy", "nav_pitch: reversed"]
    assert log.notes[:2] == (
        "timestamp never changes",
        "no row is complete: the last number before each ATTITUDE.roll is taken",
    )


def test_lerobot_data_sets(lerobot):
    log = read_log(lerobot)
    assert log.names == ("pan.pos", "lift.pos") and log.begins.sum() == 2
    assert log.step == pytest.approx(1 / 30) == log.usual_delay
    pan, lift = diagnose(log).actuators
    assert pan.status == "healthy" and pan.delay_s == pytest.approx(1 / 30, abs=1e-3)
    assert lift.sentence == "lift.pos: reversed"


def test_rows_with_missing_numbers_are_dropped(table, tmp_path):
    table.loc[[4, 9], "response.a"] = np.nan
    table.drop(columns="t").to_csv(tmp_path / "log.csv", index=False)
    log = read_log(tmp_path / "log.csv")
    assert log.notes == (
        "2 of 60 rows were dropped: numbers are missing or infinite",
        "no column t, time or timestamp: times are in rows",
    )
    assert len(log.command) == 58 and log.seconds[4] == 5


DATES = pd.date_range("2024-05-01 12:00:00.05", periods=60, freq="100ms", tz="UTC")


@pytest.mark.parametrize(
    ("column", "times", "note"),
    [
        ("time", 5 + 0.1 * np.arange(60), ()),
        ("timestamp", DATES, ()),
        ("Timestamp", DATES.strftime("%Y-%m-%dT%H:%M:%S.%fZ"), ()),
        ("time", DATES.tz_convert("Asia/Tokyo").map(str), ()),
        ("timestamp", 1714564800.05 + 0.1 * np.arange(60), ()),
        ("timestamp", 1714564800050 + 100 * np.arange(60), ("timestamp: read as ms",)),
        ("%time", 1714564800050000000 + 10**8 * np.arange(60), ("%time: read as ns",)),
        ("timestamp", 69_000_000 + 10**5 * np.arange(60), ("timestamp: read as us",)),
        ("time [ms]", 100.0 * np.arange(60), ()),
        ("time_us", 10**5 * np.arange(60), ()),
        ("Time (seconds)", 0.1 * np.arange(60), ()),
        ("timestamp_nanosec", 10**8 * np.arange(60), ()),
        (
            "time",
            DATES.strftime("%Y%m%dT%H%M%S"),
            ("time is coarse, several rows each: rows are taken as even",),
        ),
    ],
)
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_times_of_all_kinds(table, tmp_path, suffix, column, times, note):
    path = tmp_path / f"log.{suffix}"
    table = table.rename(columns={"t": column}).assign(**{column: times})
    table.to_csv(path, index=False) if suffix == "csv" else table.to_parquet(path)
    log = read_log(path)
    assert log.step == pytest.approx(0.1, rel=1e-5) and log.notes == note
    np.testing.assert_allclose(np.diff(log.seconds), 0.1, rtol=1e-4)
    np.testing.assert_allclose(log.response, log.command * [1, -1])


@pytest.mark.parametrize("names", ["qw qx qy qz", "q_w q_x q_y q_z", "q.w q.x q.y q.z"])
def test_angles_of_quaternions(tmp_path, names):
    angle = np.random.default_rng(0).uniform(-1.5, 1.5, (60, 3))
    quaternion = Rotation.from_euler("ZYX", angle).as_quat()[:, [3, 0, 1, 2]]
    table = pd.DataFrame(quaternion, columns=names.split()).assign(yaw_setpoint=angle[:, 0])
    table.assign(roll_setpoint=angle[:, 2]).to_csv(tmp_path / "log.csv", index=False)
    head = "q." if "." in names else ""
    pairs = ["yaw_setpoint", "roll_setpoint"], [f"{head}yaw", f"{head}roll"]
    log = read_log(tmp_path / "log.csv", *pairs)
    np.testing.assert_allclose(log.response, log.command, atol=1e-9)


WORD = [*(7 * [0.5]), "x", *(52 * [0.5])]


@refused(
    (lambda t: t.drop(columns=["response.a", "response.b"]), r"command\.NAME and response\.NAME"),
    (lambda t: t.drop(columns="response.a"), "a: expected a command and a response"),
    (lambda t: t.assign(**{"command.b": WORD}), r"command\.b: 'x' in row 7: expected a number"),
    (lambda t: t.assign(**{"response.a": np.nan}), "a: no number in 60 rows"),
    (lambda t: t[:1], "1 rows: expected at least 20"),
    (lambda t: t[::-1], "t goes from 5.9 to 5.8 s at row 1: expected ascending"),
    (lambda t: t.apply(lambda c: c.mask(c.index % 3 > 0)), "40 of them with missing numbers"),
    says="^/.*/log.csv: .*{}",
)
def test_tables_that_cannot_be_used(spoil, table, tmp_path):
    spoil(table).to_csv(tmp_path / "log.csv", index=False)
    read_log(tmp_path / "log.csv")


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
LFS_SAID = "a Git LFS pointer.* git lfs pull"


@refused(
    ("none.csv", None, "no such file"),
    ("log.txt", b"a", r"expected a file \.csv, \.tsv, \.parquet, \.ulg, \.mcap"),
    ("log.csv", b"", "empty"),
    ("log.csv", b"\xff\xfe\x00", "no CSV file"),
    ("log.parquet", b"no", "no parquet file"),
    *((f"log.{kind}", LFS, LFS_SAID) for kind in ("csv", "parquet", "mcap")),
)
def test_files_that_cannot_be_used(name, content, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    read_log(tmp_path / name)


@refused(
    (lambda d: (d / "meta" / "info.json").unlink(), "info.json: No such file"),
    (lambda d: (d / "meta" / "info.json").write_text("{}"), "damaged"),
    (lambda d: change_info(d, fps=10**400), "damaged"),
    (lambda d: (d / "meta" / "info.json").write_text("[" * 100_000), "damaged"),
    (lambda d: change_names(d, [[["a", "b"]], {"x": ["c"]}]), "2 numbers per row, but 3 names"),
    (lambda d: change_names(d, ["one", "one"]), "two of the 2 names are the same"),
    (lambda d: spoil_column(d, episode_index="x"), "episode_index: .*: expected numbers"),
    (lambda d: mix_lengths(d), "lists of 2 and 1 and 3 numbers"),
    (lambda d: change_info(d, fps=0), "fps=0.0: expected a rate between"),
    (lambda d: [p.unlink() for p in d.glob("data/*/*")], r"no data/chunk-\*"),
    (lambda d: next(d.glob("data/*/*")).write_bytes(b""), "no parquet file"),
    (lambda d: spoil_column(d, action=1.0), "1 numbers per row, but 2 names"),
    (lambda d: spoil_column(d, other=1.0, drop="action"), "expected action and observation.sta"),
)
def test_data_sets_that_cannot_be_used(spoil, lerobot):
    spoil(lerobot)
    read_log(lerobot)


KEYS = {"action": "actions.joint.target", "observation.state": "observation.states.joint.angle"}


def test_data_sets_with_keys_of_their_own(lerobot):
    for path in lerobot.glob("data/*/*"):
        pd.read_parquet(path).rename(columns=KEYS).to_parquet(path)
    info = json.loads((lerobot / "meta" / "info.json").read_text())
    change_info(lerobot, features={KEYS[name]: f for name, f in info["features"].items()})
    with pytest.raises(Unchosen, match="--command and --response") as error:
        read_log(lerobot)
    assert "actions.joint.target.pan.pos" in error.value.listing
    log = read_log(lerobot, [KEYS["action"]], [KEYS["observation.state"]])
    assert log.command.shape == (200, 2) and log.usual_delay == pytest.approx(1 / 30)
    assert [a.status for a in diagnose(log).actuators] == ["healthy", "changed"]


def freeze(table, first, last):
    held = table.at[first, "observation.state"]
    states = [held if first <= k < last else y for k, y in enumerate(table["observation.state"])]
    return table.assign(**{"observation.state": states})


LACKING = {
    "frames that repeat the responses before, while commands move: 3": (
        lambda path, t: freeze(t, 30, 34).to_parquet(path)
    ),
    "missing frames: 3, at 2 places": lambda path, t: t.drop(index=[40, 41, 70]).to_parquet(path),
    "180 of 200 frames are there (total_frames in meta/info.json)": (
        lambda path, t: t[:80].to_parquet(path)
    ),
    "missing episodes: 1 of 2, 1": lambda path, t: path.unlink(),
    "skipped, pointers of Git LFS (run git lfs pull): 1 of 2 files, episode_000001.parquet": (
        lambda path, t: path.write_bytes(LFS)
    ),
}


@pytest.mark.parametrize("lerobot", ["v2.1"], indirect=True)
@pytest.mark.parametrize("note", LACKING)
def test_what_a_data_set_lacks_is_said(lerobot, note):
    change_info(lerobot, total_frames=200, total_episodes=2)
    (path,) = lerobot.glob("data/*/episode_000001.parquet")
    LACKING[note](path, pd.read_parquet(path))
    log = read_log(lerobot)
    assert note in log.notes
    left_out = "missing episodes" in note or "skipped" in note
    assert log.begins.sum() == (1 if left_out else 2)


def mix_lengths(folder):
    """The numbers of lists of 1 and of 3 are as many as of lists of 2."""
    path = sorted(folder.glob("data/*/*"))[0]
    table = pd.read_parquet(path)
    lists = [np.zeros(2), *(np.zeros(1 + 2 * (row % 2)) for row in range(len(table) - 1))]
    table.assign(action=lists).to_parquet(path)


def change_info(folder, **settings):
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | settings))


def change_names(folder, names):
    feature = {"shape": [1], "names": {"motors": names}}
    change_info(folder, features={"action": feature, "observation.state": feature})


def spoil_column(folder, drop=None, **columns):
    path = sorted(folder.glob("data/*/*"))[0]
    table = pd.read_parquet(path).drop(columns=drop or [])
    table.assign(**columns).to_parquet(path)
