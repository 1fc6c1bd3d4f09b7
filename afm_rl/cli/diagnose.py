"""Say what the actuators of a robot do, from what it logged.

  afm-rl-diagnose log.csv                          columns command.NAME, response.NAME, and t (s)
  afm-rl-diagnose log.parquet --out report         diagnosis.json and index.html in report/
  afm-rl-diagnose datasets/pick_cube               a data set of LeRobot's
  afm-rl-diagnose flight.ulg                       what is in it: PX4's ULog, MCAP, bags of ROS
  afm-rl-diagnose drive.mcap --command /cmd_vel.linear.x --response /odom.twist.twist.linear.x
  afm-rl-diagnose log.csv --replay out.csv         what a correction would have known, row by row
  afm-rl-diagnose log.csv --delay 0.1              a robot whose healthy response takes 0.1 s
  afm-rl-diagnose log.csv --model arm.xml          is the model right? columns action.NAME and
                                                   state.NAME; the responses are the actions that
                                                   explain the states
  afm-rl-diagnose log.csv --model mine.step --trust mine
  afm-rl-diagnose log.csv --calibration arm.json   numbers per joint, and what would undo them
  afm-rl-diagnose log.csv --for mjlab --step 0.005 lines for the configuration of mjlab, isaaclab,
                                                   nav2, lerobot or mujoco
  afm-rl-diagnose log.csv --fail-on changed,dead   exit status 1 if an actuator is one of these

Per actuator: gain with its 95 % interval, reversed, offset, dead zone, saturation, backlash, delay,
lag, which other command drives it, noise; what changed on the way, and when. An actuator is
healthy, changed, dead, or the log cannot tell. Exit status: 0; 1 by --fail-on; 2 for a mistake.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from afm_rl.cli.error_messages import OneLineParser, errors_in_one_line
from afm_rl.errors import check_choice, check_number, printable
from afm_rl.imports import RUN, check_installed, without_collection

if TYPE_CHECKING:
    from afm_rl.diagnosis import Calibration, Diagnosis, Log
    from afm_rl.diagnosis.replay import Replayed


def main() -> None:
    """Run ``afm-rl-diagnose``; a mistake ends with one line of text and exit status 2.

    Exit status 1: an actuator has a status that ``--fail-on`` names.
    """
    parser = OneLineParser("afm-rl-diagnose", __doc__)
    add = parser.add_argument
    kinds = ".csv, .parquet, .ulg, .mcap, .db3, .bag, or a folder of LeRobot or ROS"
    add("file", metavar="FILE", type=Path, help=f"a log: {kinds}")
    add("--out", metavar="DIR", type=Path, help="folder for the results (outputs/FILE_diagnosis)")
    healthy = "delay and lag of the healthy robot (s): 0; one frame in LeRobot's data sets"
    add("--delay", metavar="SECONDS", type=float, help=healthy)
    for name, what in (("command", "commands"), ("response", "their responses, in that order")):
        names = f"names of {what}, FIELD or NAME=FIELD, with commas; a topic means all its fields"
        add(f"--{name}", metavar="FIELDS", action="append", default=[], help=names)
    episode = "the column that numbers episodes or windows (episode_index)"
    add("--episode", metavar="COLUMN", help=episode)
    units = "units of commands and responses, such as rad rad: if equal, a factor is a fault"
    add("--units", metavar=("COMMAND", "RESPONSE"), nargs=2, default=("", ""), help=units)
    replay = "also replay the log: write the prediction of a correction for each row"
    add("--replay", metavar="OUT.csv", type=Path, help=replay)
    model = (
        "model of the healthy robot: MJCF, or PACKAGE.FUNCTION, step(state, action) -> next state"
    )
    add("--model", metavar="MODEL", help=f"{model}, batched, in torch")
    trust = "a package whose function may be called, in this folder or installed"
    add("--trust", metavar="PACKAGE", action="append", default=[], help=trust)
    calibration = "write sign, scale, offset, dead zone, delay, lag and rate of each joint"
    add("--calibration", metavar="FILE.json", type=Path, help=calibration)
    tools = "print lines for the configuration of mjlab, isaaclab, nav2, lerobot or mujoco"
    add("--for", dest="tool", metavar="TOOL", help=tools)
    step = "with --for: physics step (s), the control step of the simulator / its decimation"
    add("--step", metavar="SECONDS", type=float, help=step)
    tick = "with --for lerobot: step of an encoder in units of the response, such as 360 / 4095"
    add("--tick", metavar="SIZE", type=float, help=tick)
    fail = "such as changed,dead: exit status 1 if an actuator has one of these statuses"
    add("--fail-on", metavar="STATUSES", default="", help=fail)
    add("--no-page", dest="page", action="store_false", help="write diagnosis.json only")
    options = parser.parse_args()

    with errors_in_one_line(parser.prog):
        failing = _run(options)
    if failing:
        parser.exit(1, f"{parser.prog}: --fail-on: {', '.join(failing)}\n")


def _run(options: argparse.Namespace) -> list[str]:
    """Diagnose, and return the actuators by which the command fails."""
    check_installed("diagnosis", *RUN)
    with without_collection():
        from afm_rl.diagnosis import calibrate, diagnose, tools
        from afm_rl.diagnosis.findings import STATUSES
        from afm_rl.report.diagnosis import write_diagnosis

    fail_on = [part.strip().replace("-", " ") for part in options.fail_on.split(",") if part]
    for status in fail_on:
        check_choice("--fail-on", status, STATUSES)
    if options.tool is not None:
        tools.unit_of(options.tool, options.step, options.tick)
    log, notes = _read(options)
    is_data_set = log.usual_delay > 0.0
    if options.delay is not None:
        log = replace(log, usual_delay=check_number("--delay", options.delay, low=0.0))
    command_unit, response_unit = (printable(unit, 20) for unit in options.units)
    log = replace(log, units=(command_unit, response_unit))
    _say_duration(log)
    # What it shows: a diagnosis, errors of predictions, numbers to write back.
    diagnosis = diagnose(log)
    replayed = None if options.replay is None else _replay(log)
    calibrated = is_data_set or options.calibration or options.tool is not None
    calibration = calibrate(log, diagnosis) if calibrated else None
    _print(options, diagnosis, replayed, calibration, is_data_set)
    out = options.out or Path("outputs", f"{options.file.resolve().stem}_diagnosis")
    source, page = printable(str(options.file)), options.page
    diagnosis = replace(diagnosis, notes=(*notes, *diagnosis.notes))  # they were printed
    for path in write_diagnosis(diagnosis, log, out, source, page, replayed, calibration):
        print(f"wrote {path}")
    return [printable(a.name) for a in diagnosis.actuators if a.status in fail_on]


def _read(options: argparse.Namespace) -> tuple[Log, tuple[str, ...]]:
    """Return commands and their responses, measured or through a model, and what a check said."""
    from afm_rl.diagnosis import readers

    command, response = (
        [field.strip() for text in given for field in text.split(",")]
        for given in (options.command, options.response)
    )
    try:
        with readers.bounded_memory(options.file):
            if options.model is None:
                return readers.read_log(options.file, command, response, options.episode), ()
            how = readers.TRANSITIONS, command, response, options.episode
            columns = readers.read_columns(options.file, *how)
    except readers.Unchosen as error:
        print("\n".join(error.listing))
        raise
    from afm_rl.cli import log_model  # torch takes seconds

    model = log_model.model_of(options.model, options.trust, columns)
    columns = log_model.columns_of(model, columns)
    text = str(log_model.check_columns(model, columns))
    print(text)
    return log_model.through_model(model, columns), tuple(text.splitlines())


def _replay(log: Log) -> Replayed:
    """Return the log with what a correction would have known, row by row."""
    from afm_rl.diagnosis.replay import replay
    from afm_rl.progress import Bar

    with Bar(total=1.0, desc="replaying", delay=3.0) as bar:  # s
        return replay(log, lambda share: bar.update(share - bar.n))


def _print(
    options: argparse.Namespace,
    diagnosis: Diagnosis,
    replayed: Replayed | None,
    calibration: Calibration | None,
    is_data_set: bool,
) -> None:
    """Print what was found; write the files that the options name."""
    from afm_rl.diagnosis import tools
    from afm_rl.report import diagnosis as shown
    from afm_rl.report.tables import grid_of, terminal

    shown.print_diagnosis(diagnosis)
    if calibration is not None and is_data_set:
        terminal(None).print(grid_of(shown.calibration_table(calibration, frames=True).shown))
    if calibration is not None and options.calibration:
        calibration.write(options.calibration)
        print(f"wrote {options.calibration}")
    if calibration is not None and options.tool is not None:
        print(tools.answer(options.tool, calibration, options.step, options.tick))
    if replayed is not None:
        shown.print_replay(replayed)
        print(f"wrote {shown.write_replay(replayed, options.replay)}")


def _say_duration(log: Log, many: int = 24, few: int = 3, noticed: float = 10.0) -> None:
    """Print how long the diagnosis of many actuators takes at least, as a few of them show."""
    from afm_rl.diagnosis import diagnose

    count = len(log.names)
    if count <= many:
        return
    begun = time.monotonic()
    command, response = log.command[:, :few], log.response[:, :few]
    diagnose(
        replace(log, names=log.names[:few], command=command, response=response, command_bounds=None)
    )
    seconds = (time.monotonic() - begun) * count / few
    if seconds > noticed:
        print(f"{count} actuators, {len(log)} rows: at least {seconds:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
