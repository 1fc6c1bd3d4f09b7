"""What is said of real robots, and what is not: the parts of their logs that are shipped."""

from dataclasses import replace

import pytest
from formats import LOGS

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import read_log


@pytest.mark.slow
def test_heavy_wheels():
    """Dead time .3 to .45 s, 63 % after .75 to 1 s, no more than 13 to 14 rad/s."""
    found = diagnose(read_log(LOGS / "warthog_ice_wheels.parquet"))
    for wheel in found.actuators:
        assert wheel.gain == pytest.approx(1, abs=0.08) and not wheel.reversed
        assert 0.2 < wheel.delay_s < 0.55 and wheel.delay_s + wheel.lag_s < 1.0
        assert 12.5 < wheel.saturation < 14.2
        assert wheel.lost == 0 and not wheel.changes and wheel.unexplained < 0.03
    assert "that is the loop's" in found.notes[-1] and "late" not in str(found)


def test_a_flight_with_a_weak_battery():
    found = diagnose(read_log(LOGS / "crazyflie_ramp.parquet"))
    x, y, z, yaw = found.actuators
    assert x.delay_s + x.lag_s == pytest.approx(0.5, abs=0.06)
    assert x.gain == pytest.approx(1, abs=0.05)
    assert [a.status for a in (y, z, yaw)] == ["cannot tell"] * 3
    assert not any(a.changes for a in found.actuators)


@pytest.mark.parametrize(
    ("controller", "gain", "delay_ms", "lag_ms"),
    [("tvlqr", 1.0, 4.9, 3.6), ("lqr", 0.88, 2.9, 3.2), ("sac", 1.0, 4.9, 3.8)],
)
def test_torques_of_a_double_pendulum(controller, gain, delay_ms, lag_ms):
    """The same motors under three controllers: 6 to 9 ms behind, and weaker at 4 N m."""
    (motor,) = diagnose(read_log(LOGS / f"double_pendulum_{controller}.csv")).actuators
    assert motor.status == "changed" and motor.gain == pytest.approx(gain, abs=0.03)
    assert 1e3 * motor.delay_s == pytest.approx(delay_ms, abs=0.3)
    assert 1e3 * motor.lag_s == pytest.approx(lag_ms, abs=0.4)
    assert motor.unexplained < 0.015 and motor.noise < 0.35  # N m


@pytest.mark.slow
def test_arms_that_a_person_moves():
    log = read_log(LOGS / "unitree_g1")
    names = ("kLeftShoulderYaw", "kRightShoulderYaw", "kRightElbow", "kRightWristYaw")
    some = [log.names.index(name) for name in names]
    columns = {kind: getattr(log, kind)[:, some] for kind in ("command", "response")}
    found = diagnose(replace(log, names=names, **columns))
    assert any("that is the loop's" in note for note in found.notes)
    left, right, elbow, wrist = found.actuators
    assert [a.status for a in (left, right, wrist)] == ["cannot tell", "healthy", "healthy"]
    assert not elbow.reversed and elbow.gain == pytest.approx(1, abs=0.05)
