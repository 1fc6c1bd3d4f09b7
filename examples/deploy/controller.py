"""Planner and action flow matching in a process of their own: a state comes in, an action goes out.

    python examples/deploy/controller.py --policy policy.pt2

Start robot.py first, or later. Without ``--policy`` planner and correction are made here; a file is
one of ``afm-rl-export method=afm_physics out=policy.pt2``. Without a state for WATCHDOG ticks the
action is SAFE. A transition across a gap teaches nothing: the robot says which action it obeyed. It
runs until it is ended (Ctrl-C, SIGTERM), then sends SAFE, writes a row per tick to ``--out`` and
prints how well it kept time.
"""

from __future__ import annotations

import argparse
import csv
import math
import signal
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from link import ENDPOINT, SAFE, WATCHDOG, Inbox, Link, Message, spread
from torch import Tensor

STATES = 3  # x (m), y (m), heading (rad)
COLUMNS = "number,missed,safe,interval,age,computing,answered,distance,v,omega".split(",")
Policy = Callable[..., tuple[Tensor, Tensor]]


class Agent:
    """A policy and its memory.

    Args:
        policy: (memory, state, goal, noise) -> (memory, action).
        sizes: how many numbers each of these has.
        noise_bound: the largest noise, in standard deviations.
        kind: of all its numbers.
    """

    def __init__(
        self, policy: Policy, sizes: dict[str, int], noise_bound: float, kind: torch.dtype
    ) -> None:
        self.policy, self.sizes, self.bound, self.kind = policy, sizes, noise_bound, kind
        self.memory = torch.zeros(sizes["memory"], dtype=kind)  # a memory of zeros begins a mission
        self.seen, self.sent = 0, -1  # numbers of the last state, and of its answer

    def act(self, state: Message, goal: list[float]) -> list[float]:
        """Return the action to execute."""
        if (state.number, state.answers) != (self.seen + 1, self.sent):
            self._tick([math.nan] * STATES, goal)  # a transition that is not known is not kept
        self.seen = state.number
        return self._tick(state.numbers, goal)

    @torch.no_grad()
    def _tick(self, state: list[float], goal: list[float]) -> list[float]:
        given = [torch.tensor(numbers, dtype=self.kind) for numbers in (state, goal)]
        if "noise" in self.sizes:
            noise = torch.empty(self.sizes["noise"], dtype=self.kind)
            given.append(torch.nn.init.trunc_normal_(noise, a=-self.bound, b=self.bound))
        self.memory, action = self.policy(self.memory, *given)
        return action.tolist()


def load(path: str) -> Agent:
    """Return what ``afm-rl-export`` wrote; it needs torch alone."""
    policy = torch._inductor.aoti_load_package(path)
    about = policy.loader.get_metadata()
    sizes = {name: int(n) for name, n in (s.rsplit(":", 1) for s in about["arguments"].split())}
    return Agent(policy, sizes, float(about["noise_bound"]), getattr(torch, about["dtype"]))


def make() -> Agent:
    """Return MPPI over the nominal physics, and the correction."""
    from afm_rl.dynamics import Dubins
    from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
    from afm_rl.transforms import ActionFlowPolicy
    from afm_rl.transforms.controller import Controller

    # The planner is shown a state of NaN after a gap, and remarks on it.
    warnings.filterwarnings("ignore", "planner: no finite return")
    model, low, high = Dubins(), torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
    world = PlanningEnv(model, GoalDistance(), low, high)
    planner = MPPI(world, box_key=("afm", "effect_bounds"))
    controller = Controller(planner, ActionFlowPolicy(model, planner.action_spec))
    return Agent(controller, controller.sizes, controller.noise_bound, torch.float32)


def goal_at(number: int) -> list[float]:
    """Return a point (m) that goes round a circle."""
    return [3.0 * math.cos(0.05 * number), 3.0 * math.sin(0.05 * number)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", help="a file of afm-rl-export")
    parser.add_argument("--connect", default=ENDPOINT)
    parser.add_argument("--tick", type=float, default=0.1, help="s, as the robot has it")
    parser.add_argument("--out", default="ticks.csv")
    asked = parser.parse_args()
    ended = threading.Event()
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: ended.set())
    torch.set_num_threads(1)
    agent = load(asked.policy) if asked.policy else make()
    agent.act(Message(1, 0, 0.0, (0.0,) * STATES), goal_at(1))  # the first tick is the slowest
    agent.memory = torch.zeros_like(agent.memory)
    patience = WATCHDOG * asked.tick
    inbox = Inbox(STATES, patience)
    link = Link("connect", asked.connect, "robot/action", "robot/state", inbox)
    print("ready", flush=True)

    rows, before = [], 0.0
    try:
        while not ended.is_set():
            state = inbox.get(patience)
            begun, now = time.perf_counter(), time.time()
            if state is None:
                link.send(SAFE)
                agent.sent = -1  # whatever comes next does not follow from an action of the agent
                inbox.forget()
                if rows:
                    rows.append([0, 0, 1, now - before, "", "", "", "", *SAFE])
                before = now
                continue
            missed = max(0, state.number - agent.seen - 1) if rows else 0
            goal = goal_at(state.number)
            action = agent.act(state, goal)
            computing = time.perf_counter() - begun
            agent.sent = link.send(action, state.number, state.stamp)
            distance = math.dist(state.numbers[:2], goal)
            took = [now - before, now - state.stamp, computing, time.time() - state.stamp]
            rows.append([state.number, missed, 0, *took, distance, *action])
            before = now
    finally:  # also where the policy raises
        link.send(SAFE)
        link.session.close()
    write(Path(asked.out), rows)
    report(rows, inbox)


def write(path: Path, rows: list[list[float]]) -> None:
    """Write a row per tick, times in s, as a whole file."""
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    part.replace(path)


def report(rows: list[list[float]], inbox: Inbox) -> None:
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
