"""Measures: what a score declares, and how it travels with results."""

import json

import pytest

from afm_rl.errors import ArtefactError
from afm_rl.missions import LapScore, TrackingScore
from afm_rl.storage.measures import Measure, Measures


@pytest.mark.parametrize("score", [LapScore, TrackingScore])
def test_declarations_survive_a_file(score):
    assert Measures.from_json(score.measures.to_json()) == score.measures


def test_the_first_measure_is_the_headline_unless_others_say_so():
    a, b = (Measure(name, name, name) for name in "ab")
    assert Measures((a, b)).headlines == (a,)
    assert [measure.column for measure in LapScore.measures.headlines] == ["success_rate", "steps"]
    assert LapScore.measures.budget.column == "steps"
    assert TrackingScore.measures.budget is None


GOOD = json.loads(LapScore.measures.to_json())


def changed(**entries):
    return GOOD | {"each": [GOOD["each"][0] | entries]}


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        GOOD | {"each": []},
        GOOD | {"more": 1},
        GOOD | {"progress": ["a"]},
        changed(colour="red"),
        changed(better="max"),
        changed(column=""),
        changed(scale="1"),
        changed(scale=float("nan")),
        changed(digits=99),
        changed(limits=[0]),
        changed(headline=1),
        changed(title="x" * 81),
    ],
)
def test_other_declarations_are_refused(content):
    with pytest.raises(ArtefactError):
        Measures.from_json(json.dumps(content))


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000])
def test_what_is_no_json_is_refused(text):
    with pytest.raises(ArtefactError, match="no declaration of measures"):
        Measures.from_json(text)
