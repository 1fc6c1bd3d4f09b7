"""Planner and action flow matching in a process of their own: a state comes in, an action goes out.

    python examples/deploy/controller.py --policy policy.onnx --sha256 CHECKSUM

Start robot.py first, or later. Without ``--policy`` planner and correction are made here; a file is
one of ``afm-rl-export method=afm_physics out=policy.onnx``, which prints its checksum. Without a
state for WATCHDOG ticks the action is SAFE. A transition across a gap teaches nothing: the robot
says which action it obeyed. It runs until it is ended (Ctrl-C, SIGTERM), then sends SAFE, writes a
row per tick to ``--out`` and prints how well it kept time.
"""

from __future__ import annotations

import csv
import math
import signal
import threading
import time
from pathlib import Path
from typing import Any

from agent import STATES, Agent, load, make
from link import SAFE, WATCHDOG, Inbox, Link, Message, options, settings, spread

COLUMNS = "number,missed,safe,interval,age,computing,answered,distance,v,omega".split(",")


class Driver:
    """Answers states with actions.

    Args:
        agent: the policy.
        link: sends actions; has the inbox of states.
    """

    def __init__(self, agent: Agent, link: Any) -> None:
        self.agent, self.link, self.clock = agent, link, link.inbox.clock
        self.seen, self.sent = 0, -1  # numbers of the last state, and of its answer
        self.rows: list[list[float | str]] = []
        self.before = self.clock()

    def answer(self, state: Message | None) -> None:
        """Send an action for a state, or SAFE if there is none."""
        begun, now = time.perf_counter(), self.clock()
        interval, self.before = now - self.before, now
        if state is None:
            self.link.send(SAFE)
            self.sent = -1  # whatever comes next does not follow from an action of the agent
            self.link.inbox.forget()
            if self.rows:
                self.rows.append([0, 0, 1, interval, "", "", "", "", *SAFE])
            return
        missed = max(0, state.number - self.seen - 1) if self.rows else 0
        follows = (state.number, state.answers) == (self.seen + 1, self.sent)
        goal, self.seen = goal_at(state.number), state.number
        action = self.agent.act(state.numbers, goal, follows)
        computing = time.perf_counter() - begun
        self.sent = self.link.send(action, state.number, state.stamp)
        took = [interval, now - state.stamp, computing, self.clock() - state.stamp]
        distance = math.dist(state.numbers[:2], goal)
        self.rows.append([state.number, missed, 0, *took, distance, *action])


def goal_at(number: int) -> list[float]:
    """Return a point (m) that goes round a circle."""
    return [3.0 * math.cos(0.05 * number), 3.0 * math.sin(0.05 * number)]


def main() -> None:
    parser = options(__doc__.splitlines()[0], "connect")
    parser.add_argument("--policy", help="a file of afm-rl-export")
    parser.add_argument("--sha256", help="its checksum, as afm-rl-export printed it")
    parser.add_argument("--out", default="ticks.csv")
    asked = parser.parse_args()
    ended = threading.Event()
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: ended.set())
    agent = load(asked.policy, asked.sha256) if asked.policy else make()
    agent.act([0.0] * STATES, goal_at(1), follows=False)  # the first tick is the slowest
    agent.begin()
    patience = WATCHDOG * asked.tick
    inbox, config = Inbox(STATES, patience), settings("connect", asked.connect, asked.keys)
    link = Link(config, "robot/action", "robot/state", inbox)
    driver = Driver(agent, link)
    print("ready", flush=True)
    try:
        while not ended.is_set():
            driver.answer(inbox.get(patience))
    finally:  # also where the policy raises
        link.send(SAFE)
        link.session.close()
    write(Path(asked.out), driver.rows)
    report(driver.rows, inbox)


def write(path: Path, rows: list[list[float | str]]) -> None:
    """Write a row per tick, times in s, as a whole file."""
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    part.replace(path)


def report(rows: list[list[Any]], inbox: Inbox) -> None:
    """Print the table."""
    answered = [dict(zip(COLUMNS, row, strict=True)) for row in rows if not row[2]]
    print(f"{'ms':34}{'p50':>9}{'p99':>9}")
    for name, column in (
        ("between states", "interval"),
        ("age of a state on arrival", "age"),
        ("planner and correction", "computing"),
        ("from measuring to sending", "answered"),
    ):
        # What was before the first state is no interval.
        print(spread(name, [row[column] for row in answered[1:]]))
    print(
        f"{len(answered)} states answered, {sum(row['missed'] for row in answered)} missed, "
        f"{len(rows) - len(answered)} times the safe action; dropped: {dict(inbox.dropped)}"
    )


if __name__ == "__main__":
    main()
