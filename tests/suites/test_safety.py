"""Situations in which a correction could do harm: what their rules do, and the table of them."""

from dataclasses import replace

import pandas as pd
import pytest
import torch

pytest.importorskip("mujoco")


@pytest.mark.parametrize(
    ("rules", "name", "expected"),  # at steps 0, 25, 60, 90, from the fault on
    [
        ({}, "gain", [1, 1, 1, 1]),
        ({"gain": -1, "lasts": 20, "every": 60}, "gain", [-1, 1, -1, 1]),
        ({"gain": 0.3, "lasts": 50, "every": 100}, "gain", [0.3, 0.3, 1, 1]),
        ({"gain": -1, "over": 91}, "gain", [1 - 2 * k / 91 for k in (1, 26, 61, 91)]),
        ({"gain": 0.5, "then": -1}, "gain", [0.5, 0.5, -0.5, -0.5]),
        ({"load": 3}, "mass", [1, 3, 1, 1]),
        ({"wind": 0.1, "ramp": 0.2}, "wind", [0.1, 0.15, 0.22, 0.28]),
        ({"swing": 0.6, "period": 100}, "wind", [0, 0.6, -0.35267, -0.35267]),
        ({"jitter": 0.1}, "dt", [1.2, 1.2, 1.2, 1.2]),
        ({"up": 0.5, "over": 91}, "up", [1 - 0.5 * k / 91 for k in (1, 26, 61, 91)]),
    ],
)
def test_what_comes_goes_and_grows(suite, rules, name, expected):
    batches = suite("batches")
    rows, luck = batches.rules_of([rules], 1), torch.full((1, 1), 2.0)
    values = [batches.rules_at(rows, time, 1.0, luck)[name].item() for time in (0, 25, 60, 90)]
    assert values == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ({}, [0.2, 0.3, 0.2, 0.5]),
        ({"stick": 0.15}, [0.2, 0.2, 0.2, 0.5]),
        ({"backlash": 0.1}, [0.1, 0.2, 0.2, 0.4]),
        ({"chatter": 0.1}, [0.3, 0.2, 0.3, 0.4]),
        ({"gain": -1}, [0.2, 0.3, -0.2, -0.5]),
        ({"up": 0.5}, [0.2, 0.3, 0.1, 0.25]),
        ({"dead": 0.1}, [0.2, 0.3, 0.1, 0.4]),
        ({"levels": 0.4}, [0.2, 0.3, 0.0, 0.4]),
        ({"lag": 1}, [0.2, 0.3, 0.25, 0.375]),
        ({"late": 1, "least": 1}, [0.2, 0.3, 0.3, 0.2]),
        ({"sway": 0.5}, [0.2, 0.3, 0.178370, 0.458983]),
    ],
)
def test_what_reaches_the_robot(suite, monkeypatch, rules, expected):
    batches, worlds = suite("batches"), suite("worlds")
    monkeypatch.setattr(batches, "SINCE", 2)
    commands, given = [0.2, 0.3, 0.2, 0.5], []

    def move(state, action, rules, force):
        given.append(action.item())
        return state + action

    world = replace(
        worlds.servos(1),
        move=move,
        policy=lambda state, step: torch.full((1, 1), commands[step]),
        steps=4,
    )
    batches.play(world, [rules], 1)
    assert given == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("names", [("WORLDS", "SITUATIONS"), ("ACTUATED", "ACTUATORS")])
def test_every_situation_has_an_effect_on_one_of_the_robots(suite, names):
    batches, worlds = suite("batches"), suite("worlds")
    kinds, table = (getattr(worlds, name) for name in names)
    situations = [{**rules, "box": 0} for rules in table.values()]
    robots = [make() for name, make in kinds.items() if name != "30 servos"]
    costs = torch.stack([batches.play(world, situations, 1) for world in robots])
    assert costs.isfinite().all()
    changed = (costs != costs[:, :1]).any(0).flatten().tolist()
    silent = [name for name, moved in zip(table, changed, strict=True) if not moved]
    assert {name.split()[-1].strip(":") for name in silent} == {"healthy"}


def test_the_unit_of_actions_makes_no_difference(suite, monkeypatch):
    batches, worlds = suite("batches"), suite("worlds")
    monkeypatch.setattr(batches, "SINCE", 4)
    world = replace(worlds.servos(1), steps=16)
    rows = [{"gain": -1.0, "box": box} for box in (0, 2, 3)]
    own, small, large = batches.play(world, rows, 2, {})
    torch.testing.assert_close(small, own, atol=1e-3, rtol=0)
    torch.testing.assert_close(large, own, atol=1e-3, rtol=0)
    alone = batches.play(world, rows[:1], 2)
    assert (own < 0.6 * alone).all()


def test_the_tables_say_what_is_better_and_what_is_worse(suite, command, monkeypatch, tmp_path):
    run, short = suite("run"), replace(suite("worlds").servos(1), steps=75)
    monkeypatch.setattr(run, "WORLDS", {"one servo": lambda: short})
    monkeypatch.setattr(run, "SITUATIONS", {"healthy": {}, "reversed": {"gain": -1.0}})
    words = ["--robots", "one servo", "--seeds", "3", "--out", tmp_path]
    said = command("run", *words, "--set", "saturation=clip", "samples=8")
    assert "| one servo | healthy |" in said
    assert "| one servo | 3 | 2 | 1 | 0 |  |\n| all |  | 2 | 1 | 0 |  |" in said


@pytest.mark.parametrize(
    "healthy, alone, corrected, verdict",
    [
        (1.0, 2.0, 1.2, "better"),
        (1.0, 1.0, 1.2, "worse"),
        (1.3, 1.0, 1.2, ""),
        (1.0, 1.2, 1.3, "worse"),
    ],
)
def test_a_fault_that_suits_the_plans_is_no_measure(suite, healthy, alone, corrected, verdict):
    costs = pd.DataFrame({"healthy": healthy, "alone": alone, "AFM": corrected}, index=range(3))
    assert suite("run").judge(costs)[""] == verdict
