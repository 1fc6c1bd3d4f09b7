"""What is said of real robots, and what is not: the parts of their logs that are shipped."""

from pathlib import Path

import pytest

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import read_log

LOGS = Path(__file__).parents[2] / "examples" / "real_logs"


def test_heavy_wheels():
    """Dead time .3 to .45 s, 63 % after .75 to 1 s, no more than 13 to 14 rad/s."""
    found = diagnose(read_log(LOGS / "warthog_ice_wheels.parquet"))
    for wheel in found.actuators:
        assert wheel.gain == pytest.approx(1, abs=0.08) and not wheel.reversed
        assert 0.25 < wheel.delay_s < 0.55 and wheel.delay_s + wheel.lag_s < 1.0
        assert 12.5 < wheel.saturation < 14.2
        assert wheel.lost == 0 and not wheel.changes and wheel.unexplained < 0.03
    assert "that is the loop's" in found.notes[-1] and "late" not in str(found)


def test_a_flight_with_a_weak_battery():
    found = diagnose(read_log(LOGS / "crazyflie_ramp.parquet"))
    x, y, z, yaw = found.actuators
    assert x.delay_s + x.lag_s == pytest.approx(0.5, abs=0.06) and x.gain == pytest.approx(
        1, abs=0.05
    )
    assert [a.status for a in (y, z, yaw)] == ["cannot tell"] * 3
    assert not any(a.changes for a in found.actuators)


def test_arms_that_a_person_moves():
    found = diagnose(read_log(LOGS / "unitree_g1"))
    assert any("that is the loop's" in note for note in found.notes)
    by_name = {a.name: a for a in found.actuators}
    assert len(by_name) == 26 and not any(a.reversed or a.status == "dead" for a in found.actuators)
    idle = [a for name, a in by_name.items() if name.startswith("kLeft")]
    assert not [a.sentence for a in idle if a.status == "changed" and "Hand" not in a.name]
