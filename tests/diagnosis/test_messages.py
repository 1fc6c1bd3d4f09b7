"""Logs of messages: ULog, MCAP, and bags of ROS 2."""

import sqlite3
from functools import partial

import numpy as np
import pytest
from formats import LOGS, mcap_of
from harness import refused
from rosbags import interfaces as qos
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import Unchosen, read_log
from afm_rl.diagnosis.readers.messages import fields_of
from afm_rl.errors import ConfigurationError

COMMAND, RESPONSE = ["/cmd_vel.linear.x", "turn=/cmd_vel.angular.z"], ["/odom.v", "/odom.w[0]"]


@pytest.fixture
def drive(tmp_path):
    """Commands at 20 Hz and odometry at 50 Hz, which follows the last command."""
    u = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    seen = (u[int((0.02 * k + 0.005) / 0.05)] for k in range(90))
    return mcap_of(
        tmp_path / "drive.mcap",
        ("/cmd_vel", 1.0, 0.05, [{"linear": {"x": x}, "angular": {"z": z}} for x, z in u]),
        ("/odom", 1.005, 0.02, [{"v": x, "w": [-z, 0.0]} for x, z in seen]),
        ("/text", 0.0, 0.0, [{"words": "begin"}]),
    )


def test_the_last_command_before_each_response_counts(drive):
    log = read_log(drive, COMMAND, RESPONSE)
    assert log.names == ("linear.x", "turn") and len(log.command) == 90
    assert log.step == pytest.approx(0.02) and log.seconds[0] == pytest.approx(1.005)
    np.testing.assert_array_equal(log.response, log.command * [1, -1])


def test_what_is_there_is_listed(drive):
    with pytest.raises(Unchosen, match="--command TOPIC.FIELD") as found:
        read_log(drive)
    assert found.value.listing == [
        "/cmd_vel (40 messages): linear.x, angular.z",
        "/odom (90 messages): v, w[0..1]",
        "/text (1 messages): no numbers that can be read",
    ]


@refused(
    (COMMAND, [], "expected both --command and --response"),
    (["/cmd_vel.linear.y"], RESPONSE[:1], r"no such name; did you mean /cmd_vel\.linear\.x"),
    (["/nothing\x1b[2J"], RESPONSE[:1], r"--command /nothing\?\[2J: there is no such name"),
    (["/cmd_vel"], ["/odom"], "2 commands .* but 3 responses"),
    (COMMAND[:1] * 2, RESPONSE, "given twice"),
)
def test_names_that_do_not_fit(command, response, drive):
    read_log(drive, command, response)


def bag_of(folder, store, storage=StoragePlugin.SQLITE3, **topics):
    """Write a bag of messages at 10 Hz, by topic."""
    with Bag(folder, version=8, storage_plugin=storage) as bag:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            connection = bag.add_connection(f"/{topic}", kind, typestore=store)
            for k, message in enumerate(messages):
                bag.write(connection, 10**8 * k, store.serialize_cdr(message, kind))
    return folder


def without_definitions(bag):
    """Remove from a bag what its types are, as older ones have it."""
    with sqlite3.connect(next(bag.glob("*.db3"))) as base:
        base.execute("DELETE FROM message_definitions")
    return bag


JOINTS = "sensor_msgs/msg/JointState"
UNKNOWN = "ackermann_msgs/msg/AckermannDriveStamped"
NEVER = qos.QosTime(0, 0)
KINDS = qos.QosHistory(1), 1, qos.QosReliability(1), qos.QosDurability(1)
LATCHED = qos.Qos(*KINDS, NEVER, NEVER, qos.QosLiveliness(1), NEVER, False)


@pytest.fixture
def bag(tmp_path):
    """A bag without definitions, a topic of an unknown type in it, and a publisher for each joint.

    What is sent to the second joint, ``other``, is the reverse of what it does.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 kp\n", UNKNOWN))
    joints, header = store.types[JOINTS], store.types["std_msgs/msg/Header"]
    at, none = header(store.types["builtin_interfaces/msg/Time"](0, 0), ""), np.zeros(0)
    u = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    with Bag(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as file:
        gains = file.add_connection("/vehicle_command_ackermann", UNKNOWN, typestore=store)
        first, seen = (file.add_connection(n, JOINTS, typestore=store) for n in ("/sent", "/seen"))
        latched = {"typestore": store, "offered_qos_profiles": (LATCHED,)}
        second = file.add_connection("/sent", JOINTS, **latched)

        def write(connection, t, names, values):
            message = joints(at, names, np.array(values), 2 * np.array(values), none)
            file.write(connection, int(1e9 * t), store.serialize_cdr(message, JOINTS))

        for k, (pan, other) in enumerate(u):
            write(first, 0.1 * k, ["pan"], [pan])
            write(second, 0.1 * k + 0.01, ["other"], [other])
            order = slice(None, None, 1 - 2 * (k % 2))
            write(seen, 0.1 * k + 0.02, ["other", "pan"][order], [-other, pan][order])
            data = store.serialize_cdr(store.types[UNKNOWN](1.0), UNKNOWN)
            file.write(gains, int(1e8 * k), data)
    return without_definitions(tmp_path / "bag")


def test_publishers_and_types_as_bags_have_them(bag):
    names = [f"position[{joint}]" for joint in ("pan", "other")]
    log = read_log(bag, [f"/sent.{n}" for n in names], [f"/seen.{n}" for n in names])
    np.testing.assert_allclose(log.response, log.command * [1, -1])
    found = [actuator.status for actuator in diagnose(log).actuators]
    assert found == ["not measured", "changed"]  # the first is an echo of its command
    note = f"/vehicle_command_ackermann: its type is not known: {UNKNOWN}"
    assert {*log.notes} >= {"/sent: 2 publishers, read as one", note}
    with pytest.raises(Unchosen) as found:
        read_log(bag)
    assert found.value.listing[-1] == note


def test_two_measurements_of_one_message_cannot_be_told(bag):
    (pan,) = diagnose(read_log(bag, ["/seen.velocity[pan]"], ["/seen.position[pan]"])).actuators
    assert pan.status == "cannot tell" and "measures its command and its response" in pan.sentence


def test_constants_of_messages_are_no_fields():
    status = get_typestore(Stores.ROS2_HUMBLE).types["sensor_msgs/msg/NavSatStatus"](0, 1)
    assert [name for name, _ in fields_of(status)] == [".status", ".service"]


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_ros_2(tmp_path, storage):
    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("Twist", "Vector3", "Quaternion")
    twist, vector, quaternion = (store.types[f"geometry_msgs/msg/{n}"] for n in names)
    u = np.random.default_rng(0).uniform(-1, 1, 30)
    sent = [twist(vector(x, 0.0, 0.0), vector(0.0, 0.0, 0.0)) for x in u]
    turned = [quaternion(0.0, 0.0, np.sin(x / 2), np.cos(x / 2)) for x in u]
    files = [bag_of(tmp_path / "bag", store, storage, cmd=sent, turned=turned)]
    if storage is StoragePlugin.MCAP:
        files += files[0].glob("*.mcap")  # also without the folder's metadata
    for file in files:
        log = read_log(file, ["/cmd.linear.x"], ["/turned.yaw"])
        np.testing.assert_allclose(log.command[:, 0], u)
        np.testing.assert_allclose(log.response, log.command)


def test_poses_of_a_turtle(tmp_path):
    """Its bags do not say what a pose is; this turtle turns the wrong way."""
    speeds = np.random.default_rng(0).uniform(-1, 1, (100, 2))
    store, pose = get_typestore(Stores.ROS2_HUMBLE), "turtlesim/msg/Pose"
    names = ("x", "y", "theta", "linear_velocity", "angular_velocity")
    store.register(get_types_from_msg("\n".join(f"float32 {name}" for name in names), pose))
    twist, vector = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Twist", "Vector3"))
    sent = [twist(vector(v, 0.0, 0.0), vector(0.0, 0.0, w)) for v, w in speeds]
    turtle = partial(store.types[pose], 5.5, 5.5, 0.1)
    seen = [turtle(np.float32(v), np.float32(-w)) for v, w in speeds]
    bag = without_definitions(bag_of(tmp_path / "bag", store, cmd_vel=sent, pose=seen))
    log = read_log(bag, COMMAND, [f"/pose.{name}" for name in names[3:]])
    np.testing.assert_allclose(log.response, log.command * [1, -1], atol=1e-6)


POSE = """geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def test_an_mcap_file_with_nested_messages(tmp_path):
    """Motors in a list, as JSON; and a pose of ROS 1, whose angles are computed."""
    yaw = np.random.default_rng(0).uniform(-1.5, 1.5, 40)
    motors = [{"state": {"motors": [{"q": 0.0}, {"q": y, "load": {"w": 1.0}}]}} for y in yaw]
    numbers = np.column_stack([np.zeros((40, 2)), np.sin(yaw / 2), np.cos(yaw / 2)])
    poses = [row.astype("<f8").tobytes() for row in numbers]
    path = mcap_of(
        tmp_path / "log.mcap",
        ("/low", 0.0, 0.1, motors),
        ("/pose", 0.0, 0.1, poses, "ros1", "my_msgs/Turned", POSE.encode()),
        ("/radio", 0.0, 0.1, [b"?"], "protobuf", "radio.Packet", b"?"),
    )
    log = read_log(path, ["yaw=/low.state.motors[1].q"], ["/pose.orientation.yaw"])
    assert log.names == ("yaw",) and log.step == pytest.approx(0.1)
    np.testing.assert_allclose(log.response, log.command, atol=1e-12)
    with pytest.raises(Unchosen) as unchosen:
        read_log(path)
    assert unchosen.value.listing[2] == "/radio (1 messages): no numbers that can be read"
    angles = "orientation.roll, orientation.pitch, orientation.yaw"
    assert unchosen.value.listing[1].endswith(f"w, {angles}")


def test_a_ulog_of_px4():
    commands = [f"vehicle_rates_setpoint.{name}" for name in ("roll", "pitch")]
    responses = [f"vehicle_attitude.{name}speed" for name in ("roll", "pitch")]
    log = read_log(LOGS / "px4_disarmed.ulg", commands, responses)
    assert log.names == ("roll", "pitch") and len(log.command) == 182
    assert log.step == pytest.approx(0.0105, abs=0.003)
    assert np.abs(log.response).max() < 0.01  # rad/s: at rest, whatever is commanded
    assert np.abs(log.command).max() > 0.5
    topic, angles = "vehicle_attitude_setpoint", ("roll", "pitch", "yaw")
    logged = [f"{topic}.{angle}_body" for angle in angles]
    computed = [f"{topic}.q_d.{angle}" for angle in angles]
    log = read_log(LOGS / "px4_disarmed.ulg", logged, computed)
    assert log.response[0, 2] == pytest.approx(-0.646, abs=1e-3)
    np.testing.assert_allclose(log.response, log.command, atol=1e-6)


def test_the_packages_are_asked_for(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyulog", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'afm-rl\[logs\]'"):
        read_log(LOGS / "px4_disarmed.ulg")
