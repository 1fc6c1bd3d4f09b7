"""A simulated robot in a process of its own: sends its state at a fixed rate, obeys actions.

    python examples/deploy/robot.py --tick 0.1

It needs Zenoh, and nothing else of this project. The signal USR1 reverses its motors, and once
more puts them right (kill -USR1 PID). Without an action for WATCHDOG ticks it stands still. It
runs until it is ended (Ctrl-C, SIGTERM), and then prints how well it kept time.
"""

from __future__ import annotations

import argparse
import os
import signal
import threading
import time
from math import cos, pi, sin

from link import ENDPOINT, SAFE, WATCHDOG, Inbox, Link, spread

DT = 0.2  # s of the robot's time in a tick


def move(pose: tuple[float, ...], v: float, omega: float) -> tuple[float, float, float]:
    """Return the pose (m, m, rad) after a tick with a speed and a turning rate."""
    x, y, heading = pose
    turned = (heading + omega * DT + pi) % (2 * pi) - pi
    return x + v * cos(heading) * DT, y + v * sin(heading) * DT, turned


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--listen", default=ENDPOINT)
    parser.add_argument("--tick", type=float, default=0.1, help="s")
    asked = parser.parse_args()
    ended, gains = threading.Event(), {"v": 1.0}
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: ended.set())
    signal.signal(signal.SIGUSR1, lambda *_: gains.update(v=-gains["v"]))

    inbox = Inbox(len(SAFE), WATCHDOG * asked.tick)
    link = Link("listen", asked.listen, "robot/state", "robot/action", inbox)
    print(f"robot {os.getpid()} at {asked.listen}, {1 / asked.tick:g} states a second", flush=True)
    pose, action, obeyed, silent = (0.0, 0.0, 0.0), SAFE, 0, WATCHDOG
    due, periods, stopped = time.monotonic(), [], 0
    begun = due
    while not ended.is_set():
        link.send(pose, answers=obeyed)
        due = max(due + asked.tick, time.monotonic())  # never two ticks at once after a pause
        ended.wait(due - time.monotonic())
        now = time.monotonic()
        periods.append(now - begun)
        begun = now
        message = inbox.get()
        if message is not None:
            action, obeyed, silent = message.numbers, message.number, 0
        else:
            silent += 1
            if silent >= WATCHDOG:
                action, obeyed = SAFE, 0
                inbox.forget()
                stopped += 1
        v, omega = action
        pose = move(pose, gains["v"] * v, omega)
    link.session.close()
    print(f"{'ms':34}{'p50':>9}{'p99':>9}")
    print(spread("between ticks", periods))
    print(f"{len(periods)} ticks, {stopped} without an action; dropped: {dict(inbox.dropped)}")


if __name__ == "__main__":
    main()
