"""Families of regimes: every seed gets a draw of its own."""

import dataclasses
import subprocess
import sys

import pytest
import torch
from harness import refused

from afm_rl.errors import ConfigurationError
from afm_rl.missions.selection import Family, find_family
from afm_rl.regimes import ActionGain, Compose, Schedule

PARAMETERS = {  # what a family may change
    "gains": {"v_gain", "omega_gain"},
    "coupling": {"rotation"},
    "bias": {"v_bias", "omega_bias"},
    "dead_zone": {"dead_zone"},
    "saturation": {"saturation"},
    "slip": {"slip_at", "slip_peak"},
    "delay": {"delay"},
    "patches": {"patch_v_gain"},
    "gain_noise": {"gain_noise"},
    "drift": {"v_gain", "omega_gain"},
}


def changed(robot, values):
    usual = dict(zip(robot.regime.names, robot.regime.identity, strict=True))
    return {name for name, value in values.items() if value != usual[name]}


def with_families(robot, **families):
    return dataclasses.replace(robot, families=families)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_family_changes_what_its_name_says(robot, name):
    draws = [find_family(name, robot).mission(seed)["regime"] for seed in range(20)]
    assert set().union(*(changed(robot, draw) for draw in draws)) == PARAMETERS[name]
    different = len({tuple(draw.values()) for draw in draws})
    assert different == 2 if name == "delay" else different > 15  # some gains stay nominal
    if f"{name}_flip" in robot.families:
        flipped = [find_family(f"{name}_flip", robot).mission(seed)["regime"] for seed in range(20)]
        assert all(draw["v_gain"] == -1.0 for draw in flipped)
        assert set().union(*(changed(robot, d) for d in flipped)) == PARAMETERS[name] | {"v_gain"}


def test_name_and_seed_decide_the_draw(robot):
    family = find_family("gains", robot)
    torch.manual_seed(1)
    first = family.mission(3)
    torch.rand(9)
    assert first == find_family("gains", robot).mission(3) != family.mission(4)
    assert find_family("drift", robot).mission(3)["regime"] != first["regime"]


@pytest.mark.slow
def test_another_process_draws_the_same():
    regime = Compose({"gain": ActionGain(["v_gain", "omega_gain"])})
    family = Family("gains", regime, [["gain"]], {})
    code = (
        "from afm_rl.missions.selection import Family\n"
        "from afm_rl.regimes import ActionGain, Compose\n"
        "regime = Compose({'gain': ActionGain(['v_gain', 'omega_gain'])})\n"
        "print(Family('gains', regime, [['gain']], {}).mission(5))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == str(family.mission(5))


def test_a_drift_is_slow(robot):
    assert find_family("drift", robot).mission(0)["ramp"] == 200
    assert find_family("gains", robot).mission(0)["ramp"] == 0


def test_changes_come_at_random_progress_and_each_is_a_new_draw(robot):
    family = find_family("changes", robot)
    plans = [family.mission(seed) for seed in range(200)]
    at = torch.tensor([plan["at"] for plan in plans])
    assert at.shape == (200, 4) and torch.equal(at, at.sort(-1).values)
    assert 0.1 <= at.min() < 0.11 and 0.89 < at.max() <= 0.9
    for plan in plans[:5]:
        first, *rest = plan["regime"]
        assert first == {} and len({tuple(draw.values()) for draw in rest}) == 4


def test_mixed_changes_pick_one_kind_each(robot):
    kinds = [PARAMETERS[name] for name in ("gains", "slip", "coupling")]
    met = set()
    for seed in range(30):
        _, *draws = find_family("mixed", robot).mission(seed)["regime"]
        for draw in draws:
            (kind,) = [k for k, names in enumerate(kinds) if changed(robot, draw) <= names][:1]
            met.add(kind)
    assert met == {0, 1, 2}


def test_without_a_draw_a_family_is_what_is_set(robot):
    fixed = with_families(robot, fixed={"draw": [[]], "set": {"v_gain": -2.0}})
    assert changed(robot, find_family("fixed", fixed).mission(0)["regime"]) == {"v_gain"}
    bare = with_families(robot, bare={"draw": [], "set": {"v_gain": -2.0}})
    assert changed(robot, find_family("bare", bare).mission(0)["regime"]) == {"v_gain"}


@refused(
    (3, "families.mine=3: expected a mapping of draw, set, ramp, changes"),
    ({"draws": ["gain"]}, "families.mine: setting='draws': expected one of draw, set"),
    ({"draw": "gain"}, "families.mine.draw='gain': expected names among delay, lag"),
    ({"draw": [["gain"], 3]}, r"families.mine.draw=\[\['gain'\], 3\]: expected names"),
    ({"draw": ["gains"]}, "families.mine.draw='gains': expected one of delay, lag"),
    ({"set": ["v_gain"]}, r"families.mine.set=\['v_gain'\]: expected a mapping of delay"),
    ({"set": {"gain": 1.0}}, "regimes: unknown parameter 'gain'"),
    ({"draw": ["gain"], "ramp": -1}, "families.mine.ramp=-1: expected a whole number"),
    ({"draw": ["gain"], "changes": 1.5}, "families.mine.changes=1.5: expected a whole number"),
)
def test_impossible_families_are_refused(settings, robot):
    find_family("mine", with_families(robot, mine=settings))


def test_a_family_needs_a_regime_to_draw_from_and_a_schedule_by_progress(robot):
    plain = dataclasses.replace(robot, regime=ActionGain(["v_gain", "omega_gain"]))
    with pytest.raises(ConfigurationError, match="families.gains: expected robot.regime to be a"):
        find_family("gains", plain)
    by_step = dataclasses.replace(robot, schedule=Schedule([3], by="step"))
    assert find_family("gains", by_step).changes == 0
    with pytest.raises(ConfigurationError, match="families.changes.changes=4: .*by=progress"):
        find_family("changes", by_step)
    with pytest.raises(ConfigurationError, match="regimes='nope': expected one of gains, coup"):
        find_family("nope", robot)
