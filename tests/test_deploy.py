"""The loop of examples/deploy: messages, robot and controller in processes of their own, ROS 2."""

import csv
import importlib
import math
import os
import signal
import socket
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import torch

from afm_rl.dynamics import Dubins

pytest.importorskip("zenoh")
FOLDER = Path(__file__).resolve().parents[1] / "examples" / "deploy"
sys.path.insert(0, str(FOLDER))
import controller  # noqa: E402
import robot  # noqa: E402
from link import SAFE, WATCHDOG, Inbox, Link, Message, spread  # noqa: E402

TICK = 0.15  # s; on a busy machine planner and correction may take most of 0.1


def state(number=1, answers=0, stamp=None, numbers=(1.0, 2.0, 3.0)):
    return Message(number, answers, time.time() if stamp is None else stamp, numbers)


def test_the_newest_sound_message_is_kept_and_read_once():
    inbox = Inbox(3, late=1.0)
    sent = [state(1), state(2), state(4, answers=7)]
    for message in sent:
        inbox.put(message.pack())
    assert inbox.get() == sent[-1] and inbox.get() is None
    assert inbox.dropped == {"replaced by a newer one": 2}


BAD = {
    "garbage": (lambda: b"\x93garbage", "damaged"),
    "nothing": (lambda: b"", "damaged"),
    "garbage of the right length": (lambda: bytes(range(len(state().pack()))), "damaged"),
    "a bit that flipped": (lambda: b"\x0d" + state(9).pack()[1:], "damaged"),
    "too short": (lambda: state(9, numbers=(1.0, 2.0)).pack(), "damaged"),
    "too long": (lambda: state(9, numbers=(1.0,) * 4).pack(), "damaged"),
    "not a number": (lambda: state(9, numbers=(1.0, math.nan, 3.0)).pack(), "damaged"),
    "infinite": (lambda: state(9, numbers=(1.0, -math.inf, 3.0)).pack(), "damaged"),
    "a stamp that is none": (lambda: state(9, stamp=math.nan).pack(), "damaged"),
    "late": (lambda: state(9, stamp=time.time() - 2.0).pack(), "late"),
    "from the future": (lambda: state(9, stamp=time.time() + 2.0).pack(), "late"),
    "doubled": (lambda: state(5).pack(), "doubled"),
    "out of order": (lambda: state(4).pack(), "out of order"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_messages_are_dropped_and_counted(case):
    make, kind = BAD[case]
    inbox = Inbox(3, late=1.0)
    inbox.put(state(5).pack())
    assert inbox.get().number == 5
    inbox.put(make())
    assert inbox.get() is None and inbox.dropped == {kind: 1}
    inbox.put(state(6).pack())
    assert inbox.get().number == 6


def test_a_message_that_lay_too_long_is_late():
    inbox = Inbox(3, late=0.02)
    inbox.put(state(1).pack())
    time.sleep(0.03)
    assert inbox.get() is None and inbox.dropped == {"late": 1}


def test_a_sender_that_was_restarted_is_heard_after_the_watchdog():
    inbox = Inbox(3, late=1.0)
    inbox.put(state(50).pack())
    assert inbox.get()
    inbox.put(state(1).pack())
    assert inbox.get() is None
    inbox.forget()
    inbox.put(state(2).pack())
    assert inbox.get().number == 2


def test_the_table_has_median_and_the_slowest_of_a_hundred():
    assert spread("x", [k / 1e3 for k in range(101)]).split() == ["x", "50.00", "99.00"]
    assert spread("x", []).split() == ["x", "-", "-"]


def test_the_robot_moves_as_the_model_says():
    pose, model = (0.3, -0.2, 3.0), Dubins(dt=robot.DT)
    expected = model(torch.tensor(pose), torch.tensor([0.7, 1.2]))
    torch.testing.assert_close(torch.tensor(robot.move(pose, 0.7, 1.2)), expected)


def test_transitions_count_if_the_robot_obeyed_the_last_action():
    readings = []

    def policy(memory, reading, goal):
        readings.append(reading[0].item())
        return memory, goal

    agent = controller.Agent(policy, {"memory": 1}, 0.0, torch.float32)
    given = [(1, 0), (2, 1), (3, 2), (5, 3), (6, 3), (7, 5)]  # state 4 lost, action 4 not obeyed
    for sent, (number, answers) in enumerate(given, 1):
        assert agent.act(state(number, answers, numbers=(number, 0, 0)), [0.5, 0.5]) == [0.5, 0.5]
        agent.sent = sent
    unknown = [k for k, reading in enumerate(readings) if math.isnan(reading)]
    assert [readings[k + 1] for k in unknown] == [1, 5, 6]


def test_a_file_says_what_it_takes(monkeypatch):
    def policy(memory, reading, goal, noise):
        assert {memory.dtype, reading.dtype, goal.dtype, noise.dtype} == {torch.float64}
        assert noise.shape == (1000,) and 1.0 < noise.abs().max() <= 1.5
        return memory + 1.0, goal

    sizes = "memory:4 observation:3 goal:2 noise:1000"
    about = {"arguments": sizes, "noise_bound": "1.5", "dtype": "float64"}
    policy.loader = types.SimpleNamespace(get_metadata=lambda: about)
    monkeypatch.setattr(torch._inductor, "aoti_load_package", {"policy.pt2": policy}.get)
    agent = controller.load("policy.pt2")
    assert agent.act(state(), [0.25, 0.5]) == [0.25, 0.5]
    assert agent.memory.tolist() == [2.0] * 4  # a state that follows nothing, and this one


class Bench:
    """Robot and controller in two processes, and a third party who listens and disturbs."""

    def __init__(self, folder):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        self.csv = folder / "ticks.csv"
        self.robot = self.start("robot.py", "--listen", self.endpoint)
        self.controller = self.start(
            "controller.py", "--connect", self.endpoint, "--out", str(self.csv)
        )
        actions = Inbox(2, late=5.0)
        self.link = Link("connect", self.endpoint, "robot/nobody", "robot/action", actions)
        self.states = Inbox(3, late=5.0)
        self.link.session.declare_subscriber("robot/state", self.see)
        self.raw = []

    def see(self, sample):
        self.raw.append(sample.payload.to_bytes())
        self.states.put(self.raw[-1])

    def start(self, name, *options):
        command = [sys.executable, FOLDER / name, *options, "--tick", str(TICK)]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)

    def actions(self, count, until=lambda action: any(action.numbers)):
        """Wait for a number of actions of a kind; return them."""
        found, end = [], time.monotonic() + 90
        while len(found) < count and time.monotonic() < end:
            action = self.link.inbox.get(1.0)
            if action is not None and until(action):
                found.append(action)
        assert len(found) == count
        return found

    def follows(self, count, within=1.0):
        """Wait until a number of states in a row are near the goal (m)."""
        row, end = 0, time.monotonic() + 60
        while row < count and time.monotonic() < end:
            seen = self.states.get(1.0)
            near = seen and math.dist(seen.numbers[:2], controller.goal_at(seen.number)) < within
            row = row + 1 if near else 0
        assert row == count

    def end(self, process):
        process.terminate()
        out, _ = process.communicate(timeout=30)
        return process.returncode, out

    def close(self):
        for process in (self.robot, self.controller):
            if process.poll() is None:
                process.kill()
                process.wait()
        self.link.session.close()


@pytest.fixture
def bench(tmp_path):
    made = Bench(tmp_path)
    yield made
    made.close()


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_robot_and_controller_in_two_processes(bench):
    # Reversed motors are corrected: the robot follows the goal again.
    assert all(action.answers for action in bench.actions(12))
    bench.robot.send_signal(signal.SIGUSR1)
    before = len(bench.raw)
    bench.actions(25)
    bench.follows(10)

    # What is not sound reaches neither planner nor motors.
    put, last = bench.link.session.put, bench.raw[-1]
    for data in (b"garbage", last[:-1], state(10**9, numbers=(math.nan,) * 3).pack()):
        put("robot/state", data)
    put("robot/state", state(10**9, stamp=time.time() - 9.0).pack())
    put("robot/state", bench.raw[before])
    for data in (b"", state(10**9, numbers=(math.nan, 0.0)).pack()):
        put("robot/action", data)
    bench.actions(5)

    # A robot that is held for some ticks gets the safe action, and is driven on afterwards.
    bench.robot.send_signal(signal.SIGSTOP)
    (safe,) = bench.actions(1, until=lambda action: action.answers == 0)
    assert safe.numbers == SAFE
    bench.robot.send_signal(signal.SIGCONT)
    bench.actions(10)
    bench.follows(5)

    status, out = bench.end(bench.controller)
    assert status == 0
    assert "'damaged': 3" in out and "'late': " in out and "'out of order': " in out
    for name in ("between states", "planner and correction", "from measuring to sending"):
        (line,) = [line for line in out.splitlines() if line.startswith(name)]
        p50, p99 = map(float, line.split()[-2:])
        assert 0.0 < p50 <= p99
    with bench.csv.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == controller.COLUMNS
    stops = [k for k, row in enumerate(rows) if row["safe"] == "1"]
    assert stops and all(float(rows[k]["v"]) == 0.0 for k in stops)
    assert rows[-1]["safe"] == "0" and abs(float(rows[-1]["v"])) > 0.0

    # Nobody sends actions any more, so the robot stands still.
    time.sleep((WATCHDOG + 2) * TICK)
    standing = bench.states.get(5.0)
    assert bench.states.get(5.0).numbers == standing.numbers
    status, out = bench.end(bench.robot)
    assert status == 0
    assert "'damaged': 2" in out and "between ticks" in out
    assert not list(bench.csv.parent.glob("*.part"))


@pytest.fixture
def ros2_node(monkeypatch):
    """Return the module of the ROS 2 node, with stand-ins for what it imports from there."""

    class Record(types.SimpleNamespace):
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)
            setattr(self, name, Record())
            return getattr(self, name)

    class Node:
        def __init__(self, name):
            self.sent, self.period = [], None

        def create_publisher(self, kind, topic, depth):
            return types.SimpleNamespace(publish=self.sent.append)

        def create_subscription(self, kind, topic, callback, depth):
            pass

        def create_timer(self, period, callback):
            self.period = period

    stand_ins = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseStamped": Record, "Twist": Record},
        "nav_msgs": {},
        "nav_msgs.msg": {"Odometry": Record},
    }
    for name, contents in stand_ins.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "ros2_node", raising=False)
    return importlib.import_module("ros2_node")


def test_the_ros_2_node_acts_on_odometry_and_stops_without(ros2_node):
    given = []

    def policy(memory, reading, goal):
        given.append(reading.tolist())
        return memory, 0.1 * goal

    agent = controller.Agent(policy, {"memory": 1}, 0.0, torch.float32)
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

    assert node.period == 0.2 and tick(1.0) == [SAFE]  # there is no goal
    goal = ros2_node.PoseStamped()
    goal.pose.position.x, goal.pose.position.y = 5.0, -3.0
    node.on_goal(goal)
    (sent,) = tick(1.0)
    assert sent == pytest.approx((0.5, -0.3))
    assert math.isnan(given[0][0]) and given[1] == pytest.approx([1.0, 2.0, 0.5])
    assert len(tick(1.1)) == 1 and len(given) == 3
    assert tick() == [] and tick() == [SAFE] and tick(math.nan) == [SAFE]
    assert len(tick(1.2)) == 1 and math.isnan(given[3][0]) and len(given) == 5
