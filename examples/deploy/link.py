"""Numbered messages between a robot and its controller, over Zenoh.

    pip install 'afm-rl[deploy]'

A message is a few numbers, and in 28 bytes more: its own number, the number of the other side's
message that it answers, a stamp, and a checksum. A reader gets the newest sound one; what is
damaged, late, doubled, out of order or far ahead is dropped and counted.

The checksum finds damage, not forgery: beyond one machine both sides need keys (keys.sh).
"""

from __future__ import annotations

import argparse
import json
import math
import struct
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import quantiles
from typing import Any, NamedTuple

import zenoh

ENDPOINT = "tcp/127.0.0.1:7447"
HERE = ("127.0.0.1", "localhost")
WATCHDOG = 2  # ticks without a message, after which a side does what is safe
AHEAD = 100  # messages that may be missed at once; after more, a robot has done what is safe
SAFE = (0.0, 0.0)  # the safe action of this robot: it stands still


class Message(NamedTuple):
    """A state, or an action."""

    number: int  # of the sender's messages, from 1 on
    answers: int  # an action: its state; a state: the action obeyed since the last one; 0: none
    stamp: float  # when the state was measured, s (time.time); an action has that of its state
    numbers: tuple[float, ...]

    def pack(self) -> bytes:
        """Return the message as bytes."""
        count = len(self.numbers)
        body = struct.pack(f"<qqd{count}d", self.number, self.answers, self.stamp, *self.numbers)
        return body + struct.pack("<I", zlib.crc32(body))


class Inbox:
    """Keeps the newest message of a sender, and counts in :attr:`dropped` what it did not take.

    Args:
        size: how many numbers a message has.
        late: age (s) at which a message is too old; the clocks of both machines must agree better
            than this, as NTP has it.
        clock: what time it is (s).
    """

    def __init__(self, size: int, late: float, clock: Callable[[], float] = time.time) -> None:
        self.layout, self.late, self.clock = struct.Struct(f"<qqd{size}dI"), late, clock
        self.dropped: Counter[str] = Counter()
        self.last = 0
        self.kept: Message | None = None
        self.arrival = threading.Condition()

    def put(self, data: bytes) -> None:
        """Take what has arrived."""
        with self.arrival:
            message, fault = self._read(data)
            if fault:
                self.dropped[fault] += 1
                return
            if self.kept is not None:
                self.dropped["replaced by a newer one"] += 1
            self.kept, self.last = message, message.number
            self.arrival.notify()

    def _read(self, data: bytes) -> tuple[Message | None, str]:
        if len(data) != self.layout.size:
            return None, "damaged"
        number, answers, stamp, *numbers, checksum = self.layout.unpack(data)
        if checksum != zlib.crc32(data[:-4]) or not all(map(math.isfinite, (stamp, *numbers))):
            return None, "damaged"
        if number <= self.last:
            return None, "doubled" if number == self.last else "out of order"
        if self.last and number > self.last + AHEAD:
            return None, "far ahead"
        message = Message(number, answers, stamp, tuple(numbers))
        return message, "late" if self._is_late(message) else ""

    def _is_late(self, message: Message) -> bool:
        return abs(self.clock() - message.stamp) > self.late

    def _has_one(self) -> bool:
        if self.kept is not None and self._is_late(self.kept):  # it became so before it was read
            self.kept = None
            self.dropped["late"] += 1
        return self.kept is not None

    def get(self, timeout: float = 0.0) -> Message | None:
        """Return the newest message that was not read; wait for one for ``timeout`` (s)."""
        with self.arrival:
            self.arrival.wait_for(self._has_one, timeout)
            message, self.kept = self.kept, None
            return message

    def forget(self) -> None:
        """Take messages from number 1 on again: the sender may have been restarted."""
        with self.arrival:
            self.last = 0


def options(description: str, side: str) -> argparse.ArgumentParser:
    """Return a parser of what both sides are told about the link."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(f"--{side}", default=ENDPOINT, help="PROTOCOL/HOST:PORT")
    parser.add_argument("--keys", help="folder of keys.sh, for an endpoint tls/HOST:PORT")
    parser.add_argument("--tick", type=float, default=0.1, help="s, the same on both sides")
    return parser


def settings(side: str, endpoint: str, keys: str | None) -> zenoh.Config:
    """Return how Zenoh is set: nobody without a key of ours gets through, if there are keys."""
    protocol, _, host = endpoint.partition("/")
    if (protocol == "tls") != bool(keys):
        raise SystemExit(f"{endpoint}: tls/HOST:PORT and --keys belong together")
    if not keys and host.rpartition(":")[0] not in HERE:
        raise SystemExit(f"{endpoint}: anybody there could drive the robot; make keys (keys.sh)")
    config: dict[str, Any] = {
        "listen/endpoints": [],  # else it would listen to everybody
        f"{side}/endpoints": [endpoint],  # side: listen or connect
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000},
    }
    if keys:
        mine = Path(keys) / ("robot" if side == "listen" else "controller")
        config["transport/link/protocols"] = ["tls"]
        config["transport/link/tls"] = {
            "root_ca_certificate": str(Path(keys) / "authority.pem"),
            "enable_mtls": True,  # the robot asks for a key, too
            f"{side}_private_key": f"{mine}.key",
            f"{side}_certificate": f"{mine}.pem",
        }
    found = zenoh.Config()
    for name, value in config.items():
        found.insert_json5(name, json.dumps(value))
    return found


class Link:
    """Sends to one key, and has the :class:`Inbox` of another."""

    def __init__(self, config: zenoh.Config, sends: str, receives: str, inbox: Inbox) -> None:
        self.session, self.inbox, self.number = zenoh.open(config), inbox, 0
        drop = zenoh.CongestionControl.DROP  # a receiver that stands still must not hold us up
        make = self.session.declare_publisher
        self.publisher = make(sends, congestion_control=drop, express=True)
        self.session.declare_subscriber(receives, lambda got: inbox.put(got.payload.to_bytes()))

    def send(self, numbers: Sequence[float], answers: int = 0, stamp: float | None = None) -> int:
        """Send the next message, stamped now if nothing else is said; return its number."""
        self.number += 1
        stamp = self.inbox.clock() if stamp is None else stamp
        self.publisher.put(Message(self.number, answers, stamp, tuple(numbers)).pack())
        return self.number


def spread(name: str, seconds: Sequence[float]) -> str:
    """Return a line of a table: median and the slowest of a hundred, in ms."""
    if len(seconds) < 2:
        return f"{name:34}{'-':>9}{'-':>9}"
    cuts = quantiles(seconds, n=100, method="inclusive")
    return f"{name:34}{1e3 * cuts[49]:9.2f}{1e3 * cuts[98]:9.2f}"
