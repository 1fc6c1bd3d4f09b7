"""The folder of a run."""

import os

import pandas as pd
import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.report import write_run
from afm_rl.report.events import FILE
from afm_rl.report.results_files import read_missions


def quiet(line):
    pass


def files(folder):
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )


def test_all_files_of_a_run(tmp_path, make_results, laps, ring):
    lines = []
    folder = tmp_path / "new" / "run"
    written = write_run(folder, *make_results(), laps, [ring], echo=lines.append)
    assert files(folder) == [
        "figures/learning.png",
        "figures/trajectory.png",
        "measures.json",
        "missions.csv",
        "steps.parquet",
        f"tensorboard/adaptive/{FILE}",
        f"tensorboard/oracle/{FILE}",
        f"tensorboard/physics/{FILE}",
    ]
    assert sorted(written) == sorted(folder / name for name in files(folder))
    assert len(lines) == 6
    assert all(str(folder) in line for line in lines)


def test_missions_keep_their_columns_order_and_digits(tmp_path, make_results, laps):
    missions, steps = make_results(seeds=2)
    write_run(str(tmp_path), missions, steps, laps, figures=False, tensorboard=False, echo=quiet)
    assert files(tmp_path) == ["measures.json", "missions.csv", "steps.parquet"]
    head = (tmp_path / "missions.csv").read_text().splitlines()[0]
    assert head == (
        "mission,method,track,v_gain,omega_gain,seed,success_rate,steps,reached,targets,finished,"
        "seconds"
    )
    stored = pd.read_csv(tmp_path / "missions.csv")
    pd.testing.assert_frame_equal(
        stored[missions.columns].astype(missions.dtypes), missions, check_exact=True
    )


def test_steps_come_back_as_they_were(tmp_path, make_results, laps):
    missions, steps = make_results()
    write_run(tmp_path, missions, steps, laps, figures=False, tensorboard=False, echo=quiet)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "steps.parquet"), steps)


def test_several_missions_are_compared(tmp_path, make_results, laps, ring):
    write_run(tmp_path, *make_results(seeds=2), laps, [ring], tensorboard=False, echo=quiet)
    assert "figures/summary.png" in files(tmp_path)


def test_robots_that_have_no_place_have_no_map(tmp_path, make_results, laps):
    missions, steps = make_results()
    write_run(tmp_path, missions, steps.drop(columns="x"), laps, tensorboard=False, echo=quiet)
    assert files(tmp_path) == [
        "figures/learning.png",
        "measures.json",
        "missions.csv",
        "steps.parquet",
    ]


def test_echo_is_print_unless_told_otherwise(tmp_path, make_results, laps, capsys):
    write_run(tmp_path, *make_results(), laps, figures=False, tensorboard=False)
    assert f"wrote {tmp_path / 'missions.csv'}" in capsys.readouterr().out


def test_writing_again_replaces_and_leaves_the_rest_alone(tmp_path, make_results, laps, ring):
    (tmp_path / "notes.txt").write_text("mine")
    write_run(tmp_path, *make_results(), laps, [ring], echo=quiet)
    before = files(tmp_path)
    write_run(tmp_path, *make_results(seeds=1, v_gains=[0.5]), laps, [ring], echo=quiet)
    assert files(tmp_path) == before
    assert pd.read_csv(tmp_path / "missions.csv")["v_gain"].eq(0.5).all()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_write_that_fails_leaves_the_old_file(tmp_path, make_results, laps, ring, monkeypatch):
    write_run(tmp_path, *make_results(), laps, [ring], echo=quiet)
    before = {name: (tmp_path / name).read_bytes() for name in files(tmp_path)}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigurationError, match="No space left"):
        write_run(tmp_path, *make_results(v_gains=[0.5]), laps, [ring], echo=quiet)
    assert {name: (tmp_path / name).read_bytes() for name in files(tmp_path)} == before


def test_a_figure_that_fails_costs_no_numbers(tmp_path, make_results, laps, monkeypatch):
    def broken(*_):
        raise RuntimeError("no figure")

    monkeypatch.setattr("afm_rl.report.folder.draw_learning", broken)
    with pytest.raises(RuntimeError, match="no figure"):
        write_run(tmp_path, *make_results(), laps, echo=quiet)
    assert {"missions.csv", "steps.parquet"} <= set(files(tmp_path))


def test_frames_that_do_not_fit_write_nothing(tmp_path, make_results, laps):
    missions, steps = make_results()
    with pytest.raises(ConfigurationError, match="occurs twice"):
        write_run(tmp_path / "run", missions.assign(mission=0), steps, laps, echo=quiet)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_what_people_read_does_not_grow_with_the_steps(tmp_path, make_results, laps, ring):
    missions, steps = make_results(["physics"], v_gains=range(4), seeds=1)
    missions = missions.assign(method=["a", "a", "b", "b"], steps=4999)
    whole = pd.concat([steps.assign(t=steps["t"] + 400 * k) for k in range(13)])
    whole = whole[whole["t"] < 5000].sort_values(["mission", "t"], ignore_index=True)
    assert len(whole) == 20_000
    sizes = []
    for name, rows in {"whole": whole, "tenth": whole[whole["t"] < 500]}.items():
        write_run(tmp_path / name, missions, rows, laps, [ring], echo=quiet)
        read = [p for p in (tmp_path / name).rglob("*") if p.is_file() and p.suffix != ".parquet"]
        sizes.append(sum(path.stat().st_size for path in read))
    assert sizes[0] < 1.2 * sizes[1]


def test_a_name_that_is_a_formula_stays_a_text(tmp_path, make_results, laps):
    name = "=cmd|' /C calc'!A0"
    missions, steps = make_results(["oracle"])
    missions = missions.assign(method=name)
    write_run(tmp_path, missions, steps, laps, figures=False, tensorboard=False, echo=quiet)
    cells = pd.read_csv(tmp_path / "missions.csv")["method"]
    assert cells.tolist() == ["'" + name]
    assert read_missions(tmp_path / "missions.csv", laps)["method"].tolist() == [name]
