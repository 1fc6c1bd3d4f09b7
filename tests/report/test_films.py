"""Films of missions."""

import io
import sys

import numpy as np
import pandas as pd
import pytest
from PIL import Image, ImageSequence

from afm_rl.errors import ConfigurationError
from afm_rl.film import BAND, ENCODERS, FRAMES, check_video, frames, shown
from afm_rl.report import read_runs, scenes, write_films
from afm_rl.report.scenes import map_scene
from afm_rl.storage.files import file_name
from afm_rl.storage.manifest import write_manifest
from afm_rl.storage.measures import Measure, Measures

MSE = Measures((Measure("mse", "MSE", "mean squared error", "m²", "lower", digits=5),))


def quiet(line):
    pass


@pytest.fixture
def drive(make_results):
    """Steps of one mission."""
    return make_results(methods=("oracle",))[1]


def fly(ticks):
    """Tables of one flight."""
    t, changed = np.arange(ticks), (np.arange(ticks) >= 10).astype(int)
    x, y = 2 * np.cos(0.05 * t), 2 * np.sin(0.05 * t)
    steps = pd.DataFrame({"mission": 0, "t": t, "x": x, "y": y, "z": 0.1 * changed})
    steps = steps.assign(goal_x=x, goal_y=y, goal_z=0.0, corrected=changed, regime_active=changed)
    steps = steps.assign(planned_thrust=0.3, executed_thrust=0.3 - 0.15 * changed, miss=0.0)
    row = {"mission": 0, "method": "physics", "track": "circle", "seed": 0, "mse": 0.1}
    row |= {"steps": ticks - 1, "finished": True, "seconds": 1.0}
    return pd.DataFrame([row]), steps


def pictures(data):
    """Return the pictures of a GIF ``(N, H, W, 3)`` and how long each is shown (ms)."""
    film = ImageSequence.all_frames(Image.open(io.BytesIO(data)))
    shown = np.stack([np.asarray(frame.convert("RGB")) for frame in film])
    return shown, [frame.info["duration"] for frame in film]


def test_a_film_moves_and_its_background_does_not(drive, ring):
    steps = drive[::10].reset_index(drop=True)
    scene = map_scene("a", {"oracle": steps}, ring)
    seen, durations = pictures(ENCODERS["gif"](frames(scene, range(len(steps)))))
    assert len(seen) == len(steps) and durations[-1] == 1500
    assert seen.shape[1] % 16 == seen.shape[2] % 16 == 0  # as video codecs want it
    assert (np.diff(seen.astype(int), axis=0) != 0).any((1, 2, 3)).all()
    road = np.all(seen[0] == 0xE4, -1)
    assert road.mean() > 0.05  # its colour is exact
    assert (seen[:, :20, :20] == 255).all()
    kept = (seen == seen[0]).all((0, 3)).mean()
    assert kept > 0.7


@pytest.mark.parametrize(("length", "expected"), [(1, 1), (2, 2), (FRAMES + 70, FRAMES)])
def test_long_missions_are_shown_in_strides(length, expected):
    rows = shown(length)
    assert (len(rows), rows[0], rows[-1]) == (expected, 0, length - 1)


def test_places_that_are_not_finite_are_left_out(drive):
    lost = drive.assign(x=np.where(drive["t"] > 30, np.nan, drive["x"]))
    scene = map_scene("title", {"oracle": lost.iloc[:40]})
    assert len(list(frames(scene, range(40)))) == 40


@pytest.fixture
def film(tmp_path, store):
    """Write films of missions and steps that are stored first; return their paths."""

    def write(missions, steps, *tracks, **settings):
        name, laps = f"run{len(list(tmp_path.glob('run*')))}", "success_rate" in missions
        runs = read_runs([store(name, missions, steps, *([] if laps else [MSE]))])
        return write_films(tmp_path / "films", runs, tracks, **{"echo": quiet} | settings)

    return write


@pytest.mark.parametrize(("most", "names"), [(3, []), (2, ["c/d"])])
def test_methods_share_a_film(film, tmp_path, make_results, ring, monkeypatch, most, names):
    said = []
    monkeypatch.setattr(scenes, "FEW", most)
    missions, steps = make_results(methods=("oracle", "adaptive", "physics"), v_gains=(-1.0, 2.0))
    missions["method"] = missions["method"].replace("physics", "c/d")
    written = film(missions, steps[steps["t"] % 20 == 0], ring, echo=said.append)
    names = [f"{file_name(name)}.gif" for name in ["all_methods", *names]]
    assert written == [tmp_path / "films" / name for name in names]
    assert said == [f"wrote {path}" for path in written]
    assert sorted(path.name for path in (tmp_path / "films").iterdir()) == sorted(names)
    for path in written:
        assert path.stat().st_size < 500_000


def test_a_folder_without_steps_is_refused(tmp_path, store):
    folder = store("run", *fly(6), MSE)
    (folder / "steps.parquet").unlink()
    write_manifest(folder)
    with pytest.raises(ConfigurationError, match=r"no steps\.parquet; films"):
        write_films(tmp_path / "films", read_runs([folder]), echo=quiet)


@pytest.mark.parametrize("lost", ["x", "regime_active", "goal_x"])
def test_what_a_film_needs_is_asked_for(film, tmp_path, make_results, lost):
    missions, steps = make_results(methods=("oracle",))
    for without in (steps.drop(columns=lost), steps.assign(**{lost: np.nan})):
        with pytest.raises(ConfigurationError, match=f"video: the steps lack {lost}"):
            film(missions, without)
    assert not (tmp_path / "films").exists()


def test_a_film_that_breaks_off_leaves_the_old_one(film, tmp_path, monkeypatch):
    def broken(pictures):
        next(iter(pictures))
        raise RuntimeError("a bug")

    (old,) = film(*fly(1))
    assert len(pictures(old.read_bytes())[0]) == 1
    before = old.read_bytes()
    monkeypatch.setitem(ENCODERS, "gif", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        film(*fly(3))
    assert old.read_bytes() == before and list((tmp_path / "films").iterdir()) == [old]


def test_the_other_form_is_a_video(film):
    pytest.importorskip("imageio_ffmpeg")
    from imageio.v3 import improps

    (path,) = film(*fly(8), form=check_video("mp4"))
    assert path.suffix == ".mp4"
    assert improps(path, plugin="FFMPEG").shape[1:] == (448, 960, 3)


def test_a_form_that_cannot_be_written_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert check_video("gif") == "gif"
    with pytest.raises(ConfigurationError, match=r"^video=mp4: needs .* install .afm-rl\[video\]"):
        check_video("mp4")


def test_a_robot_that_is_drawn_by_others(film, make_results):
    missions, steps = make_results(methods=("physics", "oracle"))
    asked = []

    def draw(own):
        asked.append(len(own))
        return [np.full((16, 160, 3), k % 256, np.uint8) for k in range(len(own))]

    paths = film(missions, steps, draw=draw)
    assert [path.name for path in paths] == ["physics.gif", "oracle.gif"]
    assert all(count <= FRAMES for count in asked)
    seen, _ = pictures(paths[0].read_bytes())
    assert seen.shape[:2] == (asked[0], BAND + 16)
    assert seen[:, :BAND].min() < 50 < 200 < seen[:, :BAND].max()  # the caption
