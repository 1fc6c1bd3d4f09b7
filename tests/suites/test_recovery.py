"""How soon ten tasks recover, at a small size."""

from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("mujoco")
SUITE = Path(__file__).parents[2] / "benchmarks" / "suites" / "recovery"


@pytest.fixture
def table_of(modules_of, monkeypatch, tmp_path, capsys):
    """Run the suite's command; return its rows and what it said."""
    for name in ("zoo", "furuta"):
        modules_of(SUITE.parent / name)
    run = modules_of(SUITE)("run")

    def command(*arguments):
        fixed = ["run.py", "--out", str(tmp_path), "--seeds", "1", *arguments]
        fixed += ["--zoo", str(tmp_path / "zoo")]
        monkeypatch.setattr("sys.argv", fixed)
        run.main()
        files = sorted(tmp_path.glob("*.csv"))
        return pd.concat([pd.read_csv(file) for file in files]), capsys.readouterr().out

    return command


def test_a_swimmer_that_is_corrected_recovers_and_results_are_kept(table_of):
    asked = ["--tasks", "swimmer_trpo", "--faults", "all reversed", "--steps", "360"]
    rows, said = table_of(*asked, "--methods", "alone", "AFM", "truth")
    assert "swimmer_trpo, AFM: done" in said
    seconds = rows.pivot_table(index="method", columns="fault", values="seconds")
    assert seconds.at["truth", "all reversed"] == seconds.at["AFM", "none"] == 0
    assert seconds.at["AFM", "all reversed"] < 2
    worst = rows[(rows["method"] == "alone") & (rows["fault"] == "all reversed")]
    assert worst["seconds"].tolist() == [float("inf")]
    again, said = table_of(*asked, "--methods", "alone", "AFM", "truth")
    assert "done" not in said and again.equals(rows)


def test_a_mission_of_the_command_line(table_of):
    pytest.importorskip("dm_control")
    asked = ["--faults", "one reversed", "--methods", "alone", "--steps", "10"]
    rows, _ = table_of("--tasks", "cart-pole", *asked)
    assert rows["fault"].tolist() == ["none", "one reversed"] and rows["seconds"].notna().all()


def test_a_pendulum_whose_motor_is_reversed_while_it_is_up(table_of):
    asked = ["--faults", "one reversed", "late 2", "--methods", "truth", "--steps", "140"]
    rows, said = table_of("--tasks", "Furuta", *asked)
    assert "| Furuta |" in said and (rows[rows["method"] == "truth"]["seconds"] == 0).all()
