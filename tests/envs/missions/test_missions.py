"""The entries that make up a mission."""

import pytest
import torch
from harness import refused
from tensordict import TensorDict

from afm_rl.envs import MissionFormat, MissionNoise
from afm_rl.regimes import ActionGain, Schedule

GAINS = ActionGain(["v_gain", "omega_gain"])


@pytest.fixture
def form():
    return MissionFormat(("a", "b"), GAINS, Schedule())


def complete(form, **entries):
    given = TensorDict(entries, [3])
    return form.complete(given, torch.Size([3]), 10, "cpu")


def test_missing_entries_are_nominal_and_numbered(form):
    mission = form.complete(None, torch.Size([3]), 10, "cpu")
    assert mission["track"].tolist() == [0, 0, 0]
    assert mission["seed"].tolist() == [10, 11, 12]
    assert (mission["parameters"] == torch.ones(3, 3, 2)).all()
    assert mission["ramp"].tolist() == [0, 0, 0]
    torch.testing.assert_close(mission["at"], torch.tensor([[0.15, 0.8]]).expand(3, 2))


def test_given_entries_are_kept_and_copied(form):
    track = torch.tensor([1, 0, 1], dtype=torch.int32)
    mission = complete(form, track=track)
    track[:] = 0
    assert mission["track"].tolist() == [1, 0, 1]
    assert mission["track"].dtype is torch.int64


@refused(
    ({"trak": torch.zeros(3)}, "missions: entry='trak'"),
    ({"seed": torch.zeros(3, 1)}, r"missions: seed \(3, 1\): expected \(3,\)"),
    ({"parameters": torch.full((3, 3, 2), torch.nan)}, "parameters: expected finite"),
    ({"at": torch.full((3, 2), torch.nan)}, "at: expected numbers"),
    ({"ramp": torch.tensor([0, -1, 0])}, "ramp: expected whole numbers of at least 0"),
    ({"track": torch.tensor([0, 2, 0])}, r"track: expected indices 0\.\.1"),
)
def test_impossible_entries_are_refused(entries, form):
    complete(form, **entries)


def test_a_mission_has_breakpoints_and_a_ramp_of_its_own(form):
    mission = form.build("b", regime=[{}, {"v_gain": 2.0}], at=[0.5], ramp=7)["mission"]
    assert mission["track"].item() == 1
    assert mission["parameters"].tolist() == [[1, 1], [2, 1], [2, 1]]
    assert mission["at"].tolist() == [0.5, torch.inf]
    assert mission["ramp"].item() == 7


def test_room_for_more_phases_changes_no_mission():
    form = MissionFormat(("a",), GAINS, Schedule().padded(5))
    for regime in ({"v_gain": 2.0}, [{}, {"v_gain": 2.0}, {}]):
        mission = form.build(regime=regime)["mission"]
        assert mission["parameters"][:, 0].tolist() == [1, 2, 1, 1, 1]
        assert mission["at"].tolist() == pytest.approx([0.15, 0.8, torch.inf, torch.inf])


@refused(
    ({"track": "c"}, "missions: track='c': expected one of a, b"),
    ({"track": 2}, "missions: track=2"),
    ({"track": -1}, "missions: track=-1"),
    ({"seed": -1}, "missions: seed=-1"),
    ({"ramp": -1}, "missions: ramp=-1"),
    ({"at": [0.1, 0.2, 0.3], "regime": [{}] * 4}, r"at=.*at most 2 breakpoints; .*padded"),
    ({"at": 0.5}, "missions: at=0.5: expected a list"),
    ({"at": [0.5], "regime": [{}] * 3}, "one for each of 2 phases"),
    ({"regime": {"gain": 1.0}}, "unknown parameter 'gain'; allowed: v_gain, omega_gain"),
    ({"regime": -1.0}, "expected one mapping"),
    ({"regime": [1.0, 2.0, 3.0]}, "expected one mapping"),
)
def test_impossible_descriptions_are_refused(arguments, form):
    form.build(**arguments)


def test_rows_that_do_not_draw_leave_their_streams_alone():
    seeds = torch.tensor([1, 2])
    partly, alone = MissionNoise(), MissionNoise()
    partly.normal("process", seeds, torch.tensor([True, False]))
    both = partly.normal("process", seeds)
    assert (both[1] == alone.normal("process", seeds[1:])[0]).all()
    nobody = partly.normal("process", seeds, torch.tensor([False, False]))
    assert (nobody == 0).all()
    assert partly.normal("process", seeds[:0]).shape == (0, 3)


def test_starts_and_steps_draw_from_different_streams():
    seeds = torch.tensor([5])
    noise, other = MissionNoise(), MissionNoise()
    start = noise.normal("start", seeds)
    assert (noise.normal("process", seeds) == other.normal("process", seeds)).all()
    assert (start != noise.normal("process", seeds)).all()
