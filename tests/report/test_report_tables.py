"""Means, intervals and the table in the terminal."""

import io
import math

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from afm_rl.report import print_summary, summarise, summarise_cells
from afm_rl.report.interval import mean_interval


class Terminal(io.StringIO):
    def isatty(self):
        return True


def table(missions, file):
    print_summary(missions, file)
    return file.getvalue()


@pytest.fixture
def four():
    """Two missions each of two methods, with means that are easily found by hand."""
    rows = [
        ("a", 0, 0.25, 300, False),
        ("b", 0, 1.0, 200, True),
        ("a", 1, 0.75, 300, False),
        ("b", 1, 0.5, 100, False),
    ]
    frame = pd.DataFrame(rows, columns=["method", "seed", "success_rate", "steps", "finished"])
    frame.insert(1, "track", "ring")
    frame.insert(2, "v_gain", -1.0)
    return frame.assign(seconds=1.5)


def test_means_are_those_found_by_hand(four):
    means = summarise(four).set_index("method")
    assert means.index.tolist() == ["a", "b"]
    assert means["missions"].tolist() == [2, 2]
    assert means["success"].tolist() == [0.5, 0.75]
    assert means["finished"].tolist() == [0.0, 0.5]
    assert means["steps"].tolist() == [300.0, 150.0]
    assert means["seconds"].tolist() == [3.0, 3.0]
    # Of two values, a quarter of the resamples consist of the lower one alone.
    assert means.loc["a", ["success_low", "success_high"]].tolist() == [0.25, 0.75]
    assert means.loc["b", ["steps_low", "steps_high"]].tolist() == [100.0, 200.0]
    assert means.loc["a", ["steps_low", "steps_high"]].isna().all()


def test_the_index_of_the_frame_plays_no_part(four):
    joined = four.set_index(pd.Index([0, 1, 0, 1]))
    pd.testing.assert_frame_equal(summarise(joined), summarise(four))


def test_cells_are_summarised_one_by_one(four):
    cells = summarise_cells(four.assign(v_gain=[-1.0, -1.0, 2.0, 2.0]))
    assert cells[["cell", "method", "success"]].to_numpy().tolist() == [
        ["ring, v_gain = -1", "a", 0.25],
        ["ring, v_gain = -1", "b", 1.0],
        ["ring, v_gain = 2", "a", 0.75],
        ["ring, v_gain = 2", "b", 0.5],
    ]


def test_the_interval_is_the_percentile_bootstrap():
    sample = np.random.default_rng(3).gamma(2.0, size=40)
    expected = scipy.stats.bootstrap(
        (sample,), np.mean, method="percentile", n_resamples=20_000
    ).confidence_interval
    np.testing.assert_allclose(mean_interval(sample), expected, rtol=0.03)
    assert mean_interval(sample) == mean_interval(sample)


@pytest.mark.parametrize("sample", [[0.7], [1.0, 1.0, 1.0]])
def test_no_spread_no_interval(sample):
    assert all(math.isnan(bound) for bound in mean_interval(sample))


def test_a_pipe_gets_plain_text_that_is_never_cut_off(four, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    text = table(four.replace("a", "a_method_with_a_long_name"), io.StringIO())
    assert "\x1b" not in text
    assert "a_method_with_a_long_name" in text
    assert "50.0 [25.0, 75.0]" in text
    assert "150 [100, 200]" in text
    assert "95 % interval" in text


def test_a_pipe_without_unicode_gets_a_table_too(four):
    file = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    print_summary(four, file)
    file.seek(0)
    assert "75.0 [50.0, 100.0]" in file.read()


def test_a_terminal_gets_the_best_in_bold(four, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    lines = table(four, Terminal()).splitlines()
    worse, better = (next(line for line in lines if f" {name} " in line) for name in "ab")
    assert worse.count("\x1b[1m") == 0
    assert better.count("\x1b[1m") == 3  # success, finished, steps; not seconds


def test_what_is_equal_is_not_the_best(four, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    lines = table(four[four["method"] == "a"], Terminal()).splitlines()
    assert "\x1b[1m" not in next(line for line in lines if " a " in line)


def test_cells_have_a_table_of_their_own_if_there_are_several(four):
    assert "v_gain" not in table(four, io.StringIO())
    text = table(four.assign(v_gain=[-1.0, -1.0, 2.0, 2.0]), io.StringIO())
    (row,) = (line for line in text.splitlines() if "v_gain = 2" in line)
    assert row.split()[-6:] == ["75", "%", "300", "50", "%", "100"]


def test_one_mission_has_no_interval(four):
    text = table(four[:2], io.StringIO())
    assert "[" not in text


def test_names_are_no_markup(four):
    assert "[bold]x[/bold]" in table(four.replace("a", "[bold]x[/bold]"), io.StringIO())


def test_many_methods_get_tables_below_one_another(four):
    rings = [four.assign(track=track) for track in ("ring", "oval")]
    many = [frame.assign(method=frame["method"] + str(k)) for frame in rings for k in range(4)]
    lines = table(pd.concat(many, ignore_index=True), io.StringIO()).splitlines()
    heads = [line.split()[1:] for line in lines if line.split()[:1] == ["cell"]]
    assert [name for head in heads for name in head] == list(
        dict.fromkeys(name for k in range(4) for name in (f"a{k}", f"b{k}"))
    )
    assert [len(head) for head in heads] == [6, 2]
    assert max(map(len, lines)) < 120
