"""Healthy joints with noise, rests, coarse sensors and end stops are not accused."""

from dataclasses import replace

import pytest
from real.verdicts import accused, healthy_arms

from afm_rl.diagnosis import diagnose


def test_healthy_arms_are_not_accused():
    assert not accused(6, size=2, episodes=4)


@pytest.mark.parametrize(("stop", "status"), [(0.9, "healthy"), (0.6, "changed")])
def test_an_end_stop_is_told_and_is_no_fault(stop, status):
    (log,) = healthy_arms(2, size=2, episodes=6)
    ends = stop * abs(log.command).max(0)
    found = diagnose(replace(log, response=log.response.clip(-ends, ends)))
    for actuator in found.actuators:
        assert actuator.status == status and "no more for commands" in actuator.sentence
