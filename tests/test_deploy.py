"""The loop of examples/deploy: messages, robot and controller, keys, two processes, ROS 2."""

import copy
import csv
import importlib
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.diagnosis.readers import read_log
from afm_rl.dynamics import Dubins

pytest.importorskip("zenoh")
FOLDER = Path(__file__).resolve().parents[1] / "examples" / "deploy"
sys.path.insert(0, str(FOLDER))
import agent as agents  # noqa: E402
import controller  # noqa: E402
import lerobot_arm  # noqa: E402
import link  # noqa: E402
import robot as robots  # noqa: E402
import zenoh  # noqa: E402
from link import AHEAD, SAFE, WATCHDOG, Inbox, Link, Message, spread  # noqa: E402

NOW = 1000.0


def state(number=1, answers=0, stamp=NOW, numbers=(1.0, 2.0, 3.0)):
    return Message(number, answers, stamp, numbers)


def test_the_newest_sound_message_is_kept_and_read_once():
    inbox = Inbox(3, late=1.0, clock=lambda: NOW)
    sent = [state(1), state(2), state(4, answers=7)]
    for message in sent:
        inbox.put(message.pack())
    assert inbox.get() == sent[-1] and inbox.get() is None
    assert inbox.dropped == {"replaced by a newer one": 2}


BAD = {
    "garbage of the right length": (lambda: bytes(range(len(state().pack()))), "damaged"),
    "a bit that flipped": (lambda: b"\x0d" + state(9).pack()[1:], "damaged"),
    "too short": (lambda: state(9, numbers=(1.0, 2.0)).pack(), "damaged"),
    "too long": (lambda: state(9, numbers=(1.0,) * 4).pack(), "damaged"),
    "not a number": (lambda: state(9, numbers=(1.0, math.nan, 3.0)).pack(), "damaged"),
    "infinite": (lambda: state(9, numbers=(1.0, -math.inf, 3.0)).pack(), "damaged"),
    "a stamp that is none": (lambda: state(9, stamp=math.nan).pack(), "damaged"),
    "late": (lambda: state(9, stamp=NOW - 2.0).pack(), "late"),
    "from the future": (lambda: state(9, stamp=NOW + 2.0).pack(), "late"),
    "doubled": (lambda: state(5).pack(), "doubled"),
    "out of order": (lambda: state(4).pack(), "out of order"),
    "far ahead": (lambda: state(10**15).pack(), "far ahead"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_messages_are_dropped_and_counted(case):
    make, kind = BAD[case]
    inbox = Inbox(3, late=1.0, clock=lambda: NOW)
    inbox.put(state(5).pack())
    assert inbox.get().number == 5
    inbox.put(make())
    assert inbox.get() is None and inbox.dropped == {kind: 1}
    inbox.put(state(6).pack())
    assert inbox.get().number == 6


def test_a_message_that_lay_too_long_is_late():
    inbox = Inbox(3, late=1.0, clock=iter([NOW, NOW + 1.1]).__next__)
    inbox.put(state(1).pack())
    assert inbox.get() is None and inbox.dropped == {"late": 1}


def test_the_table_has_median_and_the_slowest_of_a_hundred():
    assert spread("x", [k / 1e3 for k in range(101)]).split() == ["x", "50.00", "99.00"]
    assert spread("x", []).split() == ["x", "-", "-"]


def test_the_robot_moves_as_the_model_says():
    pose, model = (0.3, -0.2, 3.0), Dubins(dt=robots.DT)
    expected = model(torch.tensor(pose), torch.tensor([0.7, 1.2]))
    torch.testing.assert_close(torch.tensor(robots.move(pose, 0.7, 1.2)), expected)


class Wire:
    """A link without a network: what is sent lies in the other side's inbox at once."""

    def __init__(self, inbox, other):
        self.inbox, self.other, self.number = inbox, other, 0

    def send(self, numbers, answers=0, stamp=None):
        self.number += 1
        stamp = self.inbox.clock() if stamp is None else stamp
        self.other.put(Message(self.number, answers, stamp, tuple(numbers)).pack())
        return self.number


class Loop:
    """Robot and controller, tick by tick, with a clock that they share."""

    def __init__(self, make=lambda: agents.Agent(drive, EMPTY, 0, 0.0)):
        self.make, self.now = make, NOW
        self.actions = Inbox(2, WATCHDOG, lambda: self.now)
        self.states = Inbox(3, WATCHDOG, lambda: self.now)
        self.start_robot()
        self.start_controller()

    def start_robot(self):
        self.robot = robots.Robot(self.actions)
        self.up = Wire(self.actions, self.states)

    def start_controller(self):
        down = Wire(self.states, self.actions)
        self.driver = controller.Driver(self.make(), down)

    def tick(self, count=1, controlled=True):
        """Return how far the robot was from its goal in each of some ticks."""
        far = []
        for _ in range(count):
            number = self.up.send(self.robot.pose, answers=self.robot.obeyed)
            if controlled:
                self.driver.answer(self.states.get())
            self.now += 1.0
            before = self.robot.pose
            self.robot.tick()
            turned = (self.robot.pose[2] - before[2] + math.pi) % (2 * math.pi) - math.pi
            assert math.dist(before[:2], self.robot.pose[:2]) <= 1.0 * robots.DT + 1e-9
            assert abs(turned) <= 1.57 * robots.DT + 1e-9
            far.append(math.dist(self.robot.pose[:2], controller.goal_at(number)))
        return far


EMPTY = {"mode": np.zeros(1, "float32")}


def drive(memory, reading, goal):
    return memory, torch.tensor([0.5, 0.1])


def test_a_robot_whose_motors_are_reversed_follows_its_goal_again():
    loop = Loop(agents.make)
    loop.tick(40)
    loop.robot.gain = -1.0
    assert max(loop.tick(50)[-10:]) < 1.0


ANY = st.floats(-1e30, 1e30) | st.sampled_from([0.0, 1.0, -1.0, math.nan, math.inf])
WILD = st.binary(max_size=60) | st.builds(
    lambda number, age, v, omega: Message(number, 0, NOW + 6.0 - age, (v, omega)).pack(),
    st.integers(-(2**63), 2**63 - 1) | st.integers(0, 9) | st.just(10**15),
    st.floats(-3.0, 3.0) | st.floats(),
    ANY,
    ANY,
)


@given(st.sampled_from([0, 3]), st.lists(st.lists(WILD, max_size=3), min_size=3, max_size=6))
def test_whatever_arrives_the_robot_stays_in_its_box_and_is_driven_again(begun, wild):
    loop = Loop()
    loop.tick(begun)
    for messages in wild:  # absurd, stale, repeated, out of order: each tick holds to the box
        for data in messages:
            loop.actions.put(data)
        loop.tick()
    loop.tick(WATCHDOG, controlled=False)
    standing = loop.robot.pose
    loop.tick(2, controlled=False)
    assert loop.robot.pose == standing
    loop.tick(2)
    assert loop.robot.action == pytest.approx((0.5, 0.1)) and AHEAD > WATCHDOG


@pytest.mark.parametrize("side", ["robot", "controller"])
def test_a_side_that_is_restarted_drives_on(side):
    loop = Loop()
    loop.tick(20)
    getattr(loop, f"start_{side}")()
    loop.tick(WATCHDOG + 2)
    assert loop.robot.action == pytest.approx((0.5, 0.1))
    before = loop.robot.stopped
    loop.tick(10)
    assert loop.robot.stopped == before


def test_a_controller_that_hears_nothing_sends_the_safe_action_and_remembers_no_transition():
    readings = []

    def policy(memory, reading, goal):
        readings.append(reading[0].item())
        return memory, torch.tensor([0.5, 0.0])

    loop = Loop(lambda: agents.Agent(policy, EMPTY, 0, 0.0))
    loop.tick(3)
    loop.driver.answer(None)
    loop.robot.tick()
    assert loop.robot.action == SAFE and loop.driver.rows[-1][2] == 1
    loop.tick(2)
    loop.up.number += 1  # a state that was lost
    loop.tick(2)
    lost = [k for k, reading in enumerate(readings) if math.isnan(reading)]
    assert lost == [0, 4, 7]  # before what follows nothing


def test_a_file_is_asked_for_its_checksum_and_says_what_it_takes(monkeypatch, tmp_path):
    def policy(memory, reading, goal, noise):
        kinds = {x.dtype for x in (memory["mode"], reading, goal, noise)}
        assert kinds == {np.dtype("float64")}
        assert noise.shape == (1000,) and 1.0 < np.abs(noise).max() <= 1.5
        return {"mode": memory["mode"] + 1.0}, goal

    ran, path = [], tmp_path / "policy.onnx"

    def graph(code):
        ran.append(code)
        return agents.Agent(policy, {"mode": np.zeros(4)}, 1000, 1.5)

    monkeypatch.setattr(agents, "graph", graph)
    path.write_bytes(b"a program")
    for wrong in (None, "", sha256(b"another").hexdigest()):
        with pytest.raises(SystemExit, match=r"its sha256 is [0-9a-f]{64}, expected"):
            agents.load(path, wrong)
    assert not ran
    agent = agents.load(path, sha256(b"a program").hexdigest())
    assert ran == [b"a program"]
    assert agent.act([1.0, 2.0, 3.0], [0.25, 0.5], follows=False) == [0.25, 0.5]
    assert agent.memory["mode"].tolist() == [2.0] * 4  # a state that follows nothing, and this one


def test_a_file_of_somebody_else_is_refused_in_one_line(tmp_path):
    pytest.importorskip("onnxruntime")
    small = Path(__file__).parents[1] / "benchmarks/suites/legged/robots/small_policy.onnx"
    sound, path = small.read_bytes(), tmp_path / "policy.onnx"
    for content, words in ((b"", "No graph"), (sound[:200], "Protobuf"), (sound, "'noise_bound'")):
        path.write_bytes(content)
        with pytest.raises(SystemExit, match="no file of afm-rl-export that runs here") as refused:
            agents.load(path, sha256(content).hexdigest())
        assert words in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("endpoint", "keys", "words"),
    [
        ("tcp/192.168.0.7:7447", None, "anybody there could drive the robot"),
        ("tcp/0.0.0.0:7447", None, "anybody there could drive the robot"),
        ("tls/192.168.0.7:7447", None, "belong together"),
        ("tcp/127.0.0.1:7447", "keys", "belong together"),
    ],
)
def test_a_robot_on_a_network_needs_keys(endpoint, keys, words):
    with pytest.raises(SystemExit, match=words):
        link.settings("listen", endpoint, keys)


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Keys of ours, and those of somebody else."""
    if not shutil.which("openssl"):
        pytest.skip("no openssl")
    made = [tmp_path_factory.mktemp(name) for name in ("ours", "strange")]
    for folder in made:
        command = ["sh", FOLDER / "keys.sh", folder]
        subprocess.run(command, check=True, capture_output=True)
        assert {path.stat().st_mode & 0o077 for path in folder.iterdir()} == {0}
    return made


@pytest.fixture
def endpoint():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tls/127.0.0.1:{free.getsockname()[1]}"


STRANGERS = {"other keys": "tls", "no key": "tls", "no encryption": "tcp"}


def stranger(endpoint, case, ours, strange):
    """Return the settings of a client that must not drive the robot."""
    config = link.settings("connect", endpoint, str(strange))
    if case != "other keys":
        config = zenoh.Config()
        address = endpoint.replace("tls", STRANGERS[case])
        config.insert_json5("connect/endpoints", f'["{address}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        authority = f'"{ours / "authority.pem"}"'
        config.insert_json5("transport/link/tls/root_ca_certificate", authority)
    config.insert_json5("connect/timeout_ms", "500")
    config.insert_json5("connect/exit_on_failure", "true")
    return config


@pytest.mark.parametrize("case", STRANGERS)
def test_a_stranger_is_refused_and_the_controller_heard(keys, endpoint, case):
    ours, strange = keys
    heard, states = Inbox(2, late=60.0), Inbox(3, late=60.0)
    robot = Link(link.settings("listen", endpoint, str(ours)), "state", "action", heard)
    with pytest.raises(zenoh.ZError):
        Link(stranger(endpoint, case, ours, strange), "action", "state", Inbox(3, late=60.0))
    ours_too = link.settings("connect", endpoint, str(ours))
    assert ours_too.get_json("listen/endpoints") == "[]"  # it has no door of its own
    controller_side = Link(ours_too, "action", "state", states)
    found, end = None, time.monotonic() + 60
    while found is None and time.monotonic() < end:  # until the two know of each other
        controller_side.send((0.5, 0.1))
        found = heard.get(0.1)
    robot.session.close()
    controller_side.session.close()
    assert found.numbers == (0.5, 0.1) and not heard.dropped["damaged"]


def start(name, *options):
    command = [sys.executable, FOLDER / name, *map(str, options), "--tick", "0.2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def ended(process):
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    return process.returncode, out


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_robot_and_controller_in_two_processes(keys, endpoint, tmp_path):
    """With keys; the robot is restarted while the controller drives it."""
    path = tmp_path / "ticks.csv"
    listen = ["robot.py", "--listen", endpoint, "--keys", keys[0]]
    running = [start(*listen)]
    connect = ["controller.py", "--connect", endpoint, "--keys", keys[0], "--out", path]
    running.append(start(*connect))
    states = Inbox(3, late=60.0)
    watch = Link(link.settings("connect", endpoint, str(keys[0])), "none", "robot/state", states)
    try:
        for _ in range(2):
            obeyed, end = 0, time.monotonic() + 90
            while obeyed < 3 and time.monotonic() < end:
                seen = states.get(1.0)
                obeyed += bool(seen and seen.answers)
                if seen is None:
                    states.forget()
            assert obeyed == 3
            status, out = ended(running[0])
            assert status == 0 and "between ticks" in out
            running[0] = start(*listen)
        status, out = ended(running[1])
    finally:
        for process in running:
            process.kill()
            process.wait()
        watch.session.close()
    assert status == 0 and "planner and correction" in out
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == controller.COLUMNS and {row["safe"] for row in rows} == {"0", "1"}
    assert all(float(row["v"]) == 0.0 for row in rows if row["safe"] == "1")
    assert not list(tmp_path.glob("*.part"))


@pytest.fixture
def ros2_node(monkeypatch):
    """Return the module of the ROS 2 node, with stand-ins for what it imports from there."""

    class Node:
        create_subscription, create_timer = mock.Mock(), mock.Mock()

        def __init__(self, name):
            self.sent = []

        def create_publisher(self, kind, topic, depth):
            return mock.Mock(publish=self.sent.append)

    message = mock.MagicMock
    messages = mock.Mock(PoseStamped=message, Twist=message, Odometry=message)
    for name in ("geometry_msgs.msg", "nav_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, messages)
    for name in ("rclpy", "rclpy.node"):
        monkeypatch.setitem(sys.modules, name, mock.Mock(Node=Node))
    monkeypatch.delitem(sys.modules, "ros2_node", raising=False)
    return importlib.import_module("ros2_node")


def test_the_ros_2_node_acts_on_odometry_and_stops_without(ros2_node):
    given = []

    def policy(memory, reading, goal):
        given.append(reading.tolist())
        return memory, 0.1 * goal

    agent = agents.Agent(policy, EMPTY, 0, 0.0)
    node, stand_in = ros2_node.ActionFlowNode(agent, 0.2), ros2_node.Odometry

    def tick(x=None):
        if x is not None:
            message = stand_in()
            place, turn = message.pose.pose.position, message.pose.pose.orientation
            place.x, place.y, turn.z, turn.w = x, 2.0, math.sin(0.25), math.cos(0.25)
            node.on_odometry(message)
        before = len(node.sent)
        node.on_tick()
        return [(sent.linear.x, sent.angular.z) for sent in node.sent[before:]]

    node.create_timer.assert_called_once_with(0.2, node.on_tick)
    assert tick(1.0) == [SAFE]  # there is no goal
    goal = ros2_node.PoseStamped()
    goal.pose.position.x, goal.pose.position.y = 5.0, -3.0
    node.on_goal(goal)
    (sent,) = tick(1.0)
    assert sent == pytest.approx((0.5, -0.3))
    assert math.isnan(given[0][0]) and given[1] == pytest.approx([1.0, 2.0, 0.5])
    assert len(tick(1.1)) == 1 and len(given) == 3
    assert tick() == [] and tick() == [SAFE] and tick(math.nan) == [SAFE]
    assert len(tick(1.2)) == 1 and math.isnan(given[3][0]) and len(given) == 5


LEROBOT = [  # of lerobot.robots.Robot, version 0.4
    *("observation_features", "action_features", "is_connected", "connect", "is_calibrated"),
    *("calibrate", "configure", "get_observation", "send_action", "disconnect"),
]


class Arm:
    """Six servos with the interface of LeRobot's robots; the first is reversed later on."""

    is_connected = is_calibrated = True

    def __init__(self):
        self.places, self.step, self.clip = dict.fromkeys(lerobot_arm.JOINTS, 0.0), 0, math.inf

    def __getattr__(self, name):
        if name not in LEROBOT:
            raise AttributeError(name)
        return lambda: None

    def get_observation(self):
        return {**self.places, "camera": None}

    def send_action(self, action):
        self.step += 1
        action = {name: min(goal, self.clip) for name, goal in action.items()}
        for name, goal in action.items():
            reversed_now = self.step > 30 and name == lerobot_arm.JOINTS[0]
            self.places[name] += 0.5 * ((-goal if reversed_now else goal) - self.places[name])
        return action


def test_an_arm_of_lerobot_moves_as_planned_when_a_joint_is_reversed(tmp_path):
    log = tmp_path / "sent.csv"
    controller, errors = lerobot_arm.correction(), []
    agent = agents.of_tensors(controller)
    with copy.copy(lerobot_arm.CorrectedRobot(Arm(), agent, record=str(log))) as arm:
        for step in range(65):
            before = arm.get_observation()
            goals = [40 * math.sin(0.13 * step + k) for k in range(5)] + [50.0]
            sent = arm.send_action(dict(zip(lerobot_arm.JOINTS, goals, strict=True)))
            for name, goal in zip(lerobot_arm.JOINTS, goals, strict=True):
                wanted = before[name] + 0.5 * (goal - before[name])
                errors.append(abs(arm.places[name] - wanted))
    assert set(sent) == set(lerobot_arm.JOINTS) and "camera" in before
    assert max(errors[-6 * 20 :]) < 0.2 and max(errors) > 10
    recorded = read_log(log, ["command"], ["state"])
    assert recorded.names == tuple(lerobot_arm.JOINTS) and len(recorded.command) == step + 1
    assert recorded.command[-1] == pytest.approx([*sent.values()])


def test_the_wrapper_of_lerobot_has_its_interface_and_forgets_what_was_clipped():
    readings = []

    def policy(memory, state, planned):
        readings.append(state[0].item())
        return memory, planned

    arm = lerobot_arm.CorrectedRobot(Arm(), agents.Agent(policy, EMPTY, 0, 0.0))
    assert all(hasattr(arm, name) for name in LEROBOT)
    goals = dict.fromkeys(lerobot_arm.JOINTS, 10.0)
    for arm.robot.clip in (math.inf, 1.0, math.inf, math.inf):
        arm.get_observation()
        assert arm.send_action(goals) == dict.fromkeys(goals, min(10.0, arm.robot.clip))
    for _ in range(2):  # without an observation
        arm.send_action(goals)
    # Not a number: before the first, after the clipped one, and once per step without observation.
    assert [k for k, x in enumerate(readings) if math.isnan(x)] == [0, 3, 6, 7]
    assert len(readings) == 8
