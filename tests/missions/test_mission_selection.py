"""Which missions are run."""

import dataclasses

import pytest
import torch
from harness import refused

from afm_rl.errors import ConfigurationError
from afm_rl.missions.selection import (
    Family,
    _stable,
    build_missions,
    find_family,
    fit_schedule,
    select_regimes,
    select_seeds,
    select_tracks,
)
from afm_rl.regimes import ActionGain, Schedule


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        ("all", ["ethz_1", "ethz_2"]),
        ("ethz_1", ["ethz_1"]),
        (["ethz_2", "maps/mine.csv"], ["ethz_2", "maps/mine.csv"]),
    ],
)
def test_tracks(robot, written, chosen):
    assert select_tracks(written, robot) == chosen


@pytest.mark.parametrize("written", [[], None, 3, ["ethz_1", 3], {"name": "ethz_1"}])
def test_tracks_that_cannot_be_used(robot, written):
    with pytest.raises(ConfigurationError, match="^tracks=.*expected all, one of ethz_1, ethz_2"):
        select_tracks(written, robot)


def test_the_regimes_of_the_paper(robot):
    chosen = select_regimes("paper", robot)
    chosen = [entry.mission(seed=0)["regime"] for entry in chosen]
    assert len(chosen) == 11
    assert {"v_gain": -1.0, "omega_gain": 2.0} in chosen
    assert {"v_gain": 0.1, "omega_gain": -1.5} in chosen
    assert len({tuple(regime.values()) for regime in chosen}) == 11


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        ("none", [{"regime": {}}]),
        ({"v_gain": -1.7}, [{"regime": {"v_gain": -1.7}}]),
        ([{}, [{}, {"v_gain": 2.0}, {}]], [{"regime": {}}, {"regime": [{}, {"v_gain": 2.0}, {}]}]),
        ({"phases": [{}, {}, {}], "ramp": 5}, [{"regime": [{}, {}, {}], "ramp": 5}]),
        ([{"phases": [{}, {}], "at": [0.5]}], [{"regime": [{}, {}], "at": [0.5]}]),
    ],
)
def test_regimes(robot, written, chosen):
    assert [entry.mission(seed=0) for entry in select_regimes(written, robot)] == chosen


def test_families_are_chosen_by_name(robot):
    everything = select_regimes("families", robot)
    assert [family.name for family in everything] == list(robot.families)
    (slip,) = select_regimes("slip", robot)
    assert isinstance(slip, Family) and slip.name == "slip"
    mixed = select_regimes(["drift", {"v_gain": -1.0}, "slip"], robot)
    assert [entry.name for entry in mixed] == ["drift", "v_gain = -1", "slip"]


@refused(
    ([], r"^regimes=\[\]: expected paper, none, families, one of gains, .* v_gain, omega_gain"),
    (["nope"], "^regimes='nope': expected one of gains, coupling"),
    ([{"phases": {}}], r"^regimes: phases=\{\}: expected a list"),
    ([{"phases": [{}], "at": 0.5}], "^regimes: at=0.5: expected a list"),
    ([{"phases": [{}], "ramp": -1}], "^regimes: ramp=-1: expected a whole number"),
    ([{"phases": [{}], "rmap": 1}], "^regimes: setting='rmap': expected one of phases, at, ra"),
    (None, "^regimes=None: expected paper"),
    ([[{"v_gain": 1.0}, "none"]], "^regimes: 'none': expected a mapping"),
    ([{"gain": 1.0}], "^regimes: unknown parameter 'gain'; allowed: .*v_gain, omega_gain"),
)
def test_regimes_that_cannot_be_used(written, robot):
    select_regimes(written, robot)


@pytest.mark.parametrize(("written", "chosen"), [(3, [0, 1, 2]), (1, [0]), ([7, 2], [7, 2])])
def test_seeds(written, chosen):
    assert select_seeds(written) == chosen


@pytest.mark.parametrize(
    "written", [0, -3, 1.5, True, None, "three", [], [1, 1], [-1], [1.0], [True], [2**63]]
)
def test_seeds_that_cannot_be_used(written):
    with pytest.raises(ConfigurationError, match="^seeds=.*count in 1..100000, or a list of dist"):
        select_seeds(written)


def missions_of(robot, written, seeds, phases=0):
    """Return missions on two tracks, with room for more phases, and names of their regimes."""
    regimes, tracks = select_regimes(written, robot), ["ethz_1", "ethz_2"]
    schedule = fit_schedule(robot.schedule, regimes).padded(phases)
    env = robot.env(tracks=tracks, regime=robot.regime, schedule=schedule)
    missions, names = build_missions(env, tracks, regimes, seeds)
    return missions["mission"], names


def test_every_combination_is_a_mission(robot):
    written = [{}, {"v_gain": -1.0}, [{"v_gain": 2.0}, {}, {"omega_gain": 0.5}]]
    missions, _ = missions_of(robot, written, [4, 9])
    assert missions.batch_size == (12,)
    assert missions["track"].tolist() == [0] * 6 + [1] * 6
    assert missions["seed"].tolist() == [4, 9] * 6
    gains = [robot.regime.names.index(name) for name in ("v_gain", "omega_gain")]
    assert missions["parameters"][2][:, gains].tolist() == [[1, 1], [-1, 1], [1, 1]]
    assert missions["parameters"][4][:, gains].tolist() == [[2, 1], [1, 1], [1, 0.5]]


def test_each_seed_of_a_family_meets_a_draw_of_its_own_on_every_track(robot):
    written = ["changes", {"v_gain": -1.0}, {"phases": [{}, {"delay": 1}], "at": [0.4], "ramp": 3}]
    missions, _ = missions_of(robot, written, [0, 1])
    assert (missions["parameters"][0] != missions["parameters"][1]).any()
    assert (missions["parameters"][:2] == missions["parameters"][6:8]).all()
    assert missions["at"].isfinite().sum(-1).tolist() == [4, 4, 2, 2, 1, 1] * 2
    assert missions["ramp"].tolist() == [0, 0, 0, 0, 3, 3] * 2
    usual, _ = missions_of(robot, [{"v_gain": -1.0}], [0, 1], phases=5)
    assert (usual[0] == missions[2]).all()
    assert missions_of(robot, written[1:], [0])[0]["parameters"].shape[1] == 3  # phases


def test_regimes_have_names(robot):
    written = [
        *("slip", {}, {"v_gain": -1, "omega_gain": 1}, [{}, {"delay": 1, "v_bias": 0.1}, {}]),
        {"phases": [{}, {"v_gain": 2.0}], "at": [0.25], "ramp": 9},
        {"phases": [{"v_gain": 2.0}], "at": []},
    ]
    _, names = missions_of(robot, written, [0, 1])
    assert names[::2] == names[1::2] and names[:12] == names[12:]
    assert names[:12:2] == [
        "slip",
        "nominal",
        "v_gain = -1",
        "nominal; delay = 1, v_bias = 0.1; nominal",
        "nominal; v_gain = 2; at 0.25; ramp 9",
        "v_gain = 2",
    ]


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
    assert _stable("gains", 5) == 4474661581644540853  # in every process


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
