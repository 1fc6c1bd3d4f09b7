"""Means, intervals and the table in the terminal."""

import io

import pandas as pd
import pytest

from afm_rl.report import print_summary


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def table(laps):
    def write(missions, file):
        print_summary(missions, laps, file)
        return file.getvalue()

    return write


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


def test_a_pipe_gets_plain_text_that_is_never_cut_off(four, laps, table, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    text = table(four.replace("a", "a_method_with_a_long_name"), io.StringIO())
    assert "\x1b" not in text
    assert "a_method_with_a_long_name" in text
    assert "50.0 [25.0, 75.0]" in text
    assert "250 [200, 300]" in text
    assert "95 % interval" in text


def test_a_pipe_without_unicode_gets_a_table_too(four, laps, table):
    file = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    print_summary(four, laps, file)
    file.seek(0)
    assert "75.0 [50.0, 100.0]" in file.read()


def test_a_terminal_gets_the_best_in_bold(four, laps, table, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    lines = table(four, Terminal()).splitlines()
    worse, better = (next(line for line in lines if f" {name} " in line) for name in "ab")
    assert worse.count("\x1b[1m") == 0
    assert better.count("\x1b[1m") == 3  # success, finished, steps; not seconds


def test_names_are_no_markup(four, laps, table):
    assert "[bold]x[/bold]" in table(four.replace("a", "[bold]x[/bold]"), io.StringIO())


def test_many_methods_get_tables_below_one_another(four, laps, table):
    rings = [four.assign(track=track) for track in ("ring", "oval")]
    many = [frame.assign(method=frame["method"] + str(k)) for frame in rings for k in range(4)]
    lines = table(pd.concat(many, ignore_index=True), io.StringIO()).splitlines()
    heads = [line.split()[1:] for line in lines if line.split()[:1] == ["scenario"]]
    expected = [f"{name}{k}" for k in range(4) for name in "ab"]
    assert [name for head in heads for name in head] == expected
    assert [len(head) for head in heads] == [6, 2]
    assert max(map(len, lines)) < 120
