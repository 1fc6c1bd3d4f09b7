"""A simulated robot in a process of its own: sends its state at a fixed rate, obeys actions.

    python examples/deploy/robot.py --tick 0.1

It needs Zenoh, and nothing else of this project. The signal USR1 reverses its motors, and once
more puts them right (kill -USR1 PID). Without an action for WATCHDOG ticks it stands still. It
runs until it is ended (Ctrl-C, SIGTERM), and then prints how well it kept time.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from math import cos, pi, sin

from link import SAFE, WATCHDOG, Inbox, Link, options, settings, spread

DT = 0.2  # s of the robot's time in a tick
BOX = (
    (-1.0, 1.0),
    (-1.57, 1.57),
)  # m/s, rad/s: what this robot does at most, whatever is asked


def move(pose: tuple[float, ...], v: float, omega: float) -> tuple[float, float, float]:
    """Return the pose (m, m, rad) after a tick with a speed and a turning rate."""
    x, y, heading = pose
    turned = (heading + omega * DT + pi) % (2 * pi) - pi
    return x + v * cos(heading) * DT, y + v * sin(heading) * DT, turned


class Robot:
    """A robot that obeys sound actions inside its box, and stands still without any."""

    def __init__(self, inbox: Inbox) -> None:
        self.inbox, self.pose, self.gain = inbox, (0.0, 0.0, 0.0), 1.0
        self.action, self.obeyed, self.silent, self.stopped = SAFE, 0, WATCHDOG, 0

    def tick(self) -> None:
        """Obey the newest action for a tick."""
        message = self.inbox.get()
        if message is not None:
            asked = zip(message.numbers, BOX, strict=True)
            self.action = tuple(min(max(number, low), high) for number, (low, high) in asked)
            self.obeyed, self.silent = message.number, 0
        else:
            self.silent += 1
            if self.silent >= WATCHDOG:
                self.action, self.obeyed = SAFE, 0
                self.inbox.forget()
                self.stopped += 1
        v, omega = self.action
        self.pose = move(self.pose, self.gain * v, omega)


def main() -> None:
    asked = options(__doc__.splitlines()[0], "listen").parse_args()
    inbox = Inbox(len(SAFE), WATCHDOG * asked.tick)
    ended, robot = threading.Event(), Robot(inbox)
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: ended.set())
    signal.signal(signal.SIGUSR1, lambda *_: vars(robot).update(gain=-robot.gain))

    link = Link(settings("listen", asked.listen, asked.keys), "robot/state", "robot/action", inbox)
    print(f"robot {os.getpid()} at {asked.listen}, {1 / asked.tick:g} states a second", flush=True)
    due, periods = time.monotonic(), []
    begun = due
    while not ended.is_set():
        link.send(robot.pose, answers=robot.obeyed)
        due = max(due + asked.tick, time.monotonic())  # never two ticks at once after a pause
        ended.wait(due - time.monotonic())
        now = time.monotonic()
        periods.append(now - begun)
        begun = now
        robot.tick()
    link.session.close()
    print(f"{'ms':34}{'p50':>9}{'p99':>9}")
    print(spread("between ticks", periods))
    print(
        f"{len(periods)} ticks, {robot.stopped} without an action; dropped: {dict(inbox.dropped)}"
    )


if __name__ == "__main__":
    main()
