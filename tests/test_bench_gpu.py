"""The benchmark of a GPU, at a small size on the processor."""

import sys

import bench_gpu
import pytest


@pytest.fixture
def bench(monkeypatch):
    given = ["--device", "cpu", "--missions", "1", "3", "--candidates", "8", "--rounds", "1"]
    monkeypatch.setattr(sys, "argv", ["bench_gpu.py", *given])
    return bench_gpu


@pytest.mark.parametrize(("seconds", "rows"), [(300.0, ["| 1 |", "| 3 |"]), (-1.0, ["| 1 | not"])])
def test_it_prints_a_row_for_each_number_of_missions_until_time_is_over(
    bench, seconds, rows, monkeypatch, capsys
):
    monkeypatch.setattr(bench, "SECONDS", seconds)
    bench.main()
    text = capsys.readouterr().out
    assert "those of the processor: 0.0e+00" in text and all(row in text for row in rows)


def test_a_device_that_acts_otherwise_is_not_timed(bench, monkeypatch, capsys):
    actions = iter([0.1, 0.2] * 50)
    move = bench.Missions.move
    monkeypatch.setattr(
        bench.Missions, "move", lambda batch, gain: move(batch, gain) + next(actions)
    )
    with pytest.raises(SystemExit, match=r"differ by 1.0e-01 from those of the processor"):
        bench.main()
    assert "| 1 |" not in capsys.readouterr().out
