"""The command ``afm-rl-diagnose``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from afm_rl.cli.error_messages import OneLineParser, told_by

if TYPE_CHECKING:
    from afm_rl.diagnosis import Log

NAME = "afm-rl-diagnose"
KINDS = ".csv, .parquet, .ulg, .mcap, .db3, .bag, or a folder of LeRobot or ROS"
ABOUT = """\
Say what the actuators of a robot do, from what it logged.

  afm-rl-diagnose log.csv                          columns command.NAME, response.NAME, and t (s)
  afm-rl-diagnose log.parquet --out report         diagnosis.json and index.html in report/
  afm-rl-diagnose datasets/pick_cube               a data set of LeRobot's
  afm-rl-diagnose flight.ulg                       what is in it: PX4's ULog, MCAP, bags of ROS
  afm-rl-diagnose drive.mcap --command /cmd_vel.linear.x --response /odom.twist.twist.linear.x
  afm-rl-diagnose log.csv --replay out.csv         what a correction would have known, row by row
  afm-rl-diagnose log.csv --delay 0.1              a robot whose healthy response takes 0.1 s
  afm-rl-diagnose log.csv --model mine.step        columns action.NAME, state.NAME; the responses
                                                   are the actions that explain the states

Per actuator: gain with its 95 % interval, reversed, offset, dead zone, saturation, backlash, delay,
lag, which other command drives it, noise; what changed on the way, and when. An actuator is
healthy, changed, dead, or the log cannot tell.
"""


def main() -> None:
    """Run ``afm-rl-diagnose``; a mistake ends in one line and exit status 2."""
    parser = OneLineParser(NAME, ABOUT)
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=f"a log: {KINDS}")
    add("--out", metavar="DIR", type=Path, help="where to (outputs/FILE_diagnosis)")
    healthy = "delay and lag of the healthy robot (s): 0; one frame in LeRobot's data sets"
    add("--delay", metavar="SECONDS", type=float, help=healthy)
    for name, what in (("command", "commands"), ("response", "their responses, in that order")):
        told = f"names of {what}, FIELD or NAME=FIELD, with commas; a topic stands for its fields"
        add(f"--{name}", metavar="FIELDS", action="append", default=[], help=told)
    episode = "the column in which episodes or windows are numbered (episode_index)"
    add("--episode", metavar="COLUMN", help=episode)
    replay = "also replay the log: what would a correction have predicted of each row?"
    add("--replay", metavar="OUT.csv", type=Path, help=replay)
    model = "a step function, step(state, action) -> next state, in torch; code that you trust"
    add("--model", metavar="MODULE.FUNCTION", help=model)
    add("--no-page", dest="page", action="store_false", help="write diagnosis.json only")
    options = parser.parse_args()

    with told_by(NAME):
        _run(options)


def _run(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from afm_rl.diagnosis import diagnose
    from afm_rl.diagnosis.readers import Unchosen, bounded_memory, read_log
    from afm_rl.errors import check_number, printable
    from afm_rl.report.diagnosis import print_diagnosis, write_diagnosis

    if options.model is None:
        command, response = (
            [field.strip() for text in given for field in text.split(",")]
            for given in (options.command, options.response)
        )
        try:
            with bounded_memory(options.file):
                log = read_log(options.file, command, response, options.episode)
        except Unchosen as error:
            print("\n".join(error.listing))
            raise
    else:
        log = _read_effective(options.file, options.model)
    if options.delay is not None:
        log = replace(log, usual_delay=check_number("--delay", options.delay, low=0.0))
    found = diagnose(log)
    replayed = None
    if options.replay is not None:
        from afm_rl.progress import Bar
        from afm_rl.replay import replay
        from afm_rl.report.diagnosis import print_replay, write_replay

        with Bar(total=1.0, desc="replaying", delay=3.0) as bar:  # s
            replayed = replay(log, lambda share: bar.update(share - bar.n))
    out = options.out or Path("outputs", f"{options.file.resolve().stem}_diagnosis")
    print_diagnosis(found)
    if replayed is not None:
        print_replay(replayed)
        print(f"wrote {write_replay(replayed, options.replay)}")
    source, page = printable(str(options.file)), options.page
    for path in write_diagnosis(found, log, out, source, page, replayed):
        print(f"wrote {path}")


def _read_effective(path: Path, name: str) -> Log:
    """Return a log whose commands are the actions, and whose responses are effective actions."""
    from afm_rl.diagnosis.readers import TRANSITIONS, bounded_memory, read_columns
    from afm_rl.dynamics import KnownDynamics  # torch takes seconds
    from afm_rl.missions.explained import effective_log
    from afm_rl.spaces.manifold import Manifold
    from afm_rl.targets import find_code

    with bounded_memory(path):
        found = read_columns(path, TRANSITIONS)
    sys.path.insert(0, os.getcwd())
    try:
        step = find_code("--model", name)
    finally:
        sys.path.pop(0)
    model = KnownDynamics(step, Manifold(found.second.shape[1]), found.first.shape[1])
    names = tuple(found.names[0])
    return effective_log(model, names, found.second, found.first, found.t, found.episode)
