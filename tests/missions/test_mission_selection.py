"""Which missions are run."""

import pytest
from harness import refused

from afm_rl.errors import ConfigurationError
from afm_rl.missions.selection import (
    Family,
    build_missions,
    fit_schedule,
    select_regimes,
    select_seeds,
    select_tracks,
)


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        ("all", ["ethz_1", "ethz_2"]),
        ("ethz_1", ["ethz_1"]),
        (["ethz_2", "ethz_1"], ["ethz_2", "ethz_1"]),
        ("maps/mine.csv", ["maps/mine.csv"]),
        (["ethz_1", "maps/mine.csv"], ["ethz_1", "maps/mine.csv"]),
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
        ("none", [{}]),
        ({"v_gain": -1.7}, [{"v_gain": -1.7}]),
        ([{"v_gain": 2}, {"omega_gain": 0.5}], [{"v_gain": 2}, {"omega_gain": 0.5}]),
        ([[{}, {"v_gain": 2.0}, {}]], [[{}, {"v_gain": 2.0}, {}]]),
        ([{}], [{}]),
        (
            [{"phases": [{}, {"delay": 1}], "at": [0.5]}],
            [{"regime": [{}, {"delay": 1}], "at": [0.5]}],
        ),
        ({"phases": [{}, {}, {}], "ramp": 5}, [{"regime": [{}, {}, {}], "ramp": 5}]),
    ],
)
def test_regimes(robot, written, chosen):
    found = [entry.mission(seed=0) for entry in select_regimes(written, robot)]
    assert found == [
        one if isinstance(one, dict) and "regime" in one else {"regime": one} for one in chosen
    ]


def test_families_are_chosen_by_name(robot):
    everything = select_regimes("families", robot)
    assert [family.name for family in everything] == list(robot.families)
    (slip,) = select_regimes("slip", robot)
    assert isinstance(slip, Family) and slip.name == "slip"
    mixed = select_regimes(["drift", {"v_gain": -1.0}, "slip"], robot)
    assert [mixed[0].name, mixed[1].given, mixed[2]] == [
        *("drift", [{"regime": {"v_gain": -1.0}}], slip)
    ]


@refused(
    ([], r"^regimes=\[\]: expected paper, none, families, one of gains, .* v_gain, omega_gain"),
    (["nope"], "^regimes='nope': expected one of gains, coupling"),
    ([{"phases": {}}], r"^regimes: phases=\{\}: expected a list"),
    ([{"phases": [3]}], "^regimes: 3: expected a mapping of delay"),
    ([{"phases": [{"delay": 26}]}], "^regimes: delay=26: expected a finite number"),
    ([{"phases": [{}], "at": 0.5}], "^regimes: at=0.5: expected a list"),
    ([{"phases": [{}], "ramp": -1}], "^regimes: ramp=-1: expected a whole number"),
    ([{"phases": [{}], "rmap": 1}], "^regimes: setting='rmap': expected one of phases, at, ra"),
    (None, "^regimes=None: expected paper"),
    ([3], "^regimes: 3: expected a mapping of delay, .*v_gain, omega_gain"),
    ([[{"v_gain": 1.0}, "none"]], "^regimes: 'none': expected a mapping"),
    ([{"gain": 1.0}], "^regimes: unknown parameter 'gain'; allowed: .*v_gain, omega_gain"),
    ([{"v_gain": float("nan")}], "^regimes: v_gain=nan: expected a finite number"),
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


def test_every_combination_is_a_mission(robot):
    env = robot.env(tracks=["ethz_1", "ethz_2"], regime=robot.regime, schedule=robot.schedule)
    written = [{}, {"v_gain": -1.0}, [{"v_gain": 2.0}, {}, {"omega_gain": 0.5}]]
    regimes = select_regimes(written, robot)
    missions = build_missions(env, ["ethz_1", "ethz_2"], regimes, [4, 9])[0]["mission"]
    assert missions.batch_size == (12,)
    assert missions["track"].tolist() == [0] * 6 + [1] * 6
    assert missions["seed"].tolist() == [4, 9] * 6
    gains = [robot.regime.names.index(name) for name in ("v_gain", "omega_gain")]
    assert missions["parameters"][2][:, gains].tolist() == [[1, 1], [-1, 1], [1, 1]]
    assert missions["parameters"][4][:, gains].tolist() == [[2, 1], [1, 1], [1, 0.5]]


def test_each_seed_of_a_family_meets_a_draw_of_its_own_on_every_track(robot):
    tracks = ["ethz_1", "ethz_2"]
    written = ["changes", {"v_gain": -1.0}, {"phases": [{}, {"delay": 1}], "at": [0.4], "ramp": 3}]
    regimes = select_regimes(written, robot)
    schedule = fit_schedule(robot.schedule, regimes)
    assert schedule.phases == 5 and fit_schedule(robot.schedule, regimes[1:]).phases == 3
    env = robot.env(tracks=tracks, regime=robot.regime, schedule=schedule)
    missions = build_missions(env, tracks, regimes, [0, 1])[0]["mission"]
    assert (missions["parameters"][0] != missions["parameters"][1]).any()
    assert (missions["parameters"][:2] == missions["parameters"][6:8]).all()
    assert missions["at"].isfinite().sum(-1).tolist() == [4, 4, 2, 2, 1, 1] * 2
    assert missions["ramp"].tolist() == [0, 0, 0, 0, 3, 3] * 2
    usual, _ = build_missions(env, tracks, select_regimes([{"v_gain": -1.0}], robot), [0, 1])
    assert (usual["mission"][0] == missions[2]).all()


def test_regimes_have_names(robot):
    written = [
        *("slip", {}, {"v_gain": -1, "omega_gain": 1}, [{}, {"delay": 1, "v_bias": 0.1}, {}]),
        {"phases": [{}, {"v_gain": 2.0}], "at": [0.25], "ramp": 9},
        {"phases": [{"v_gain": 2.0}], "at": []},
    ]
    regimes, tracks = select_regimes(written, robot), ["ethz_1", "ethz_2"]
    schedule = fit_schedule(robot.schedule, regimes)
    env = robot.env(tracks=tracks, regime=robot.regime, schedule=schedule)
    _, names = build_missions(env, tracks, regimes, [0, 1])
    assert names[::2] == names[1::2] and names[:12] == names[12:]
    assert names[:12:2] == [
        "slip",
        "nominal",
        "v_gain = -1",
        "nominal; delay = 1, v_bias = 0.1; nominal",
        "nominal; v_gain = 2; at 0.25; ramp 9",
        "v_gain = 2",
    ]
