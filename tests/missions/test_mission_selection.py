"""Which missions are run."""

import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.missions.selection import build_missions, select_regimes, select_seeds, select_tracks


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
    ],
)
def test_regimes(robot, written, chosen):
    assert select_regimes(written, robot) == chosen


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        ([], r"^regimes=\[\]: expected paper, none, or a list .* v_gain, omega_gain"),
        (None, "^regimes=None: expected paper"),
        ("papper", "^regimes='papper': expected paper"),
        (3, "^regimes=3: expected paper"),
        ([3], "^regimes: 3: expected a mapping of v_gain, omega_gain"),
        ([[{"v_gain": 1.0}, "none"]], "^regimes: 'none': expected a mapping"),
        ([{"gain": 1.0}], "^regimes: unknown parameter 'gain'; allowed: v_gain, omega_gain"),
        ([{"v_gain": float("nan")}], "^regimes: v_gain=nan: expected a finite number"),
        ([[{}, {"omega_gain": float("inf")}]], "^regimes: omega_gain=inf: expected a finite"),
        ([{"v_gain": "fast"}], "^regimes: v_gain='fast': expected a finite number"),
        ([{"v_gain": True}], "^regimes: v_gain=True: expected a finite number"),
    ],
)
def test_regimes_that_cannot_be_used(robot, written, complaint):
    with pytest.raises(ConfigurationError, match=complaint):
        select_regimes(written, robot)


@pytest.mark.parametrize(("written", "chosen"), [(3, [0, 1, 2]), (1, [0]), ([7, 2], [7, 2])])
def test_seeds(written, chosen):
    assert select_seeds(written) == chosen


@pytest.mark.parametrize(
    "written", [0, -3, 1.5, True, None, "three", [], [1, 1], [-1], [1.0], [True], [2**63]]
)
def test_seeds_that_cannot_be_used(written):
    with pytest.raises(ConfigurationError, match="^seeds=.*count of at least 1, or a list of dist"):
        select_seeds(written)


def test_every_combination_is_a_mission(robot):
    env = robot.env(tracks=["ethz_1", "ethz_2"], regime=robot.regime, schedule=robot.schedule)
    regimes = [{}, {"v_gain": -1.0}, [{"v_gain": 2.0}, {}, {"omega_gain": 0.5}]]
    missions = build_missions(env, ["ethz_1", "ethz_2"], regimes, [4, 9])["mission"]
    assert missions.batch_size == (12,)
    assert missions["track"].tolist() == [0] * 6 + [1] * 6
    assert missions["seed"].tolist() == [4, 9] * 6
    assert missions["parameters"][2].tolist() == [[1, 1], [-1, 1], [1, 1]]
    assert missions["parameters"][4].tolist() == [[2, 1], [1, 1], [1, 0.5]]
