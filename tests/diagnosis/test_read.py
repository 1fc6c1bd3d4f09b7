"""Logs from files, and what is said about those that cannot be used."""

import json

import numpy as np
import pandas as pd
import pytest

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import read_log
from afm_rl.errors import ConfigurationError


@pytest.fixture
def table():
    u = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    columns = {"t": 0.1 * np.arange(60), "command.a": u[:, 0], "command.b": u[:, 1]}
    return pd.DataFrame(columns | {"response.b": -u[:, 1], "response.a": u[:, 0]})


NAMES = ["pan.pos", "lift.pos"]


@pytest.fixture(params=["v2.1", "v3.0"])
def lerobot(tmp_path, request):
    """Two episodes as LeRobot writes them, a file each or in one; the second motor is reversed."""
    rng = np.random.default_rng(0)
    names = {"v2.1": NAMES, "v3.0": {"lift.pos": 1, "pan.pos": 0}}[request.param]
    feature = {"dtype": "float32", "shape": [2], "names": names}
    info = {
        "codebase_version": request.param,
        "fps": 30,
        "features": {"action": feature, "observation.state": feature},
    }
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    folder, episodes = tmp_path / "data" / "chunk-000", []
    folder.mkdir(parents=True)
    for episode in range(2):
        u = rng.uniform(-1, 1, (100, 2)).astype(np.float32)
        y = np.concatenate([u[:1], u[:-1]]) * np.array([1, -1], dtype=np.float32)
        y += np.float32(1e-3) * rng.standard_normal(y.shape).astype(np.float32)
        columns = {"action": list(u), "observation.state": list(y), "episode_index": episode}
        columns |= {"timestamp": (np.arange(100) / 30).astype(np.float32)}
        episodes.append(pd.DataFrame(columns))
    if request.param == "v2.1":
        for k, episode in enumerate(episodes):
            episode.to_parquet(folder / f"episode_00000{k}.parquet")
    else:
        pd.concat(episodes).to_parquet(folder / "file-000.parquet")
    return tmp_path


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_tables(table, tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    table.to_csv(path, index=False) if suffix == "csv" else table.to_parquet(path)
    log = read_log(path)
    assert log.names == ("a", "b") and log.step == pytest.approx(0.1)
    np.testing.assert_allclose(log.response, log.command * [1, -1])


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
        "no column t: times are in rows",
    )
    assert len(log.command) == 58 and log.seconds[4] == 5


def with_cell(table, name, value):
    column = table[name].astype(object)
    column[7] = value
    return table.assign(**{name: column})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.drop(columns=["response.a", "response.b"]), r"command\.NAME and response\.NA"),
        (lambda t: t.drop(columns="response.a"), "a: expected a command and a response"),
        (lambda t: with_cell(t, "command.b", "x"), r"command\.b: 'x' in row 7: expected a number"),
        (lambda t: t.assign(**{"response.a": np.nan}), "a: no number in 60 rows"),
        (lambda t: t[:1], "1 rows: expected at least 20"),
        (lambda t: t[::-1], "t goes from 5.9 to 5.8 s at row 1: expected ascending"),
        (
            lambda t: t.astype(float).apply(lambda c: c.mask(c.index % 3 > 0)),
            "40 of them with missing numbers",
        ),
    ],
)
def test_tables_that_cannot_be_used(table, tmp_path, spoil, message):
    path = tmp_path / "log.csv"
    spoil(table).to_csv(path, index=False)
    with pytest.raises(ConfigurationError, match=message) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.csv", None, "no such file"),
        ("log.txt", b"a", r"expected a file \.csv, \.parquet, \.ulg, \.mcap"),
        ("log.csv", b"", "empty"),
        ("log.csv", b"\xff\xfe\x00", "no CSV file"),
        ("log.parquet", b"no", "no parquet file"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match=message):
        read_log(tmp_path / name)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: (d / "meta" / "info.json").unlink(), "info.json: No such file"),
        (lambda d: (d / "meta" / "info.json").write_text("{}"), "damaged"),
        (lambda d: change_info(d, fps=10**400), "damaged"),
        (lambda d: change_info(d, features={}), "no feature action or actions"),
        (lambda d: write_info(d, "[" * 100_000), "damaged"),
        (lambda d: change_names(d, [[["a", "b"]], {"x": ["c"]}]), "2 numbers per row, but 3 names"),
        (lambda d: change_names(d, ["one", "one"]), "two of the 2 names are the same"),
        (lambda d: spoil_column(d, episode_index="x"), "episode_index: .*: expected numbers"),
        (lambda d: mix_lengths(d), "lists of 2 and 1 and 3 numbers"),
        (lambda d: change_info(d, fps=0), "fps=0.0: expected a rate between"),
        (lambda d: [p.unlink() for p in d.glob("data/*/*")], r"no data/chunk-\*"),
        (lambda d: next(d.glob("data/*/*")).write_bytes(b""), "no parquet file"),
        (lambda d: spoil_column(d, action=1.0), "1 numbers per row, but 2 names"),
        (lambda d: spoil_column(d, other=1.0, drop="action"), "no column action"),
    ],
)
def test_data_sets_that_cannot_be_used(lerobot, spoil, message):
    spoil(lerobot)
    with pytest.raises(ConfigurationError, match=message):
        read_log(lerobot)


def write_info(folder, text):
    (folder / "meta" / "info.json").write_text(text)


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
