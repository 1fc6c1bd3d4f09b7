"""A page in the browser to play with: the same policy on two robots, without and with AFM.

afm-rl-play                          a half cheetah
afm-rl-play --robot hopper --open    another robot; the browser opens
afm-rl-play --robot FOLDER/go1       a legged robot of a folder (docs/howto/play.md)
afm-rl-play --policy mine.safetensors   a policy of your own, in its own task
afm-rl-play --robot hopper --policy mine.onnx   one of any origin, for this robot
"""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path

from afm_rl.cli.error_messages import OneLineParser, errors_in_one_line
from afm_rl.errors import check_count
from afm_rl.imports import RUN, check_installed


def main() -> None:
    """Run ``afm-rl-play``; a mistake ends with one line of text and exit status 2."""
    parser = OneLineParser("afm-rl-play", __doc__)
    add = parser.add_argument
    add("--robot", help="half_cheetah (the default), hopper, ant, ugv, ...; or FOLDER/NAME")
    add(
        "--policy",
        metavar="FILE",
        type=Path,
        help="file of save_policy with its task as id, or ONNX",
    )
    add(
        "--port",
        type=int,
        default=0,
        help="port of 127.0.0.1, or the next free one; by default any free port",
    )
    add("--open", action="store_true", help="open the browser")
    options = parser.parse_args()
    with errors_in_one_line(parser.prog):
        _run(options)


def _run(options: argparse.Namespace) -> None:
    check_count("--port", options.port, low=0, high=65535)
    check_installed("the page", "mujoco", "viser", *RUN, extra="play")
    import torch

    from afm_rl.play.page import Page
    from afm_rl.play.robots import make_robot
    from afm_rl.play.world import World

    torch.set_num_threads(1)
    robot = make_robot(options.robot, options.policy)
    page = Page(World(robot), f"{robot.name}: without and with AFM", options.port)
    print(f"afm-rl-play: {robot.name} at {page.url}; Ctrl-C ends it", flush=True)
    if options.open:
        webbrowser.open(page.url)
    try:
        page.run()
    except KeyboardInterrupt:
        pass
    finally:
        page.end()


if __name__ == "__main__":
    main()
