"""A study from the command line."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from omegaconf import DictConfig

from afm_rl.envs import load_track
from afm_rl.missions.study import run_study
from afm_rl.report import print_summary, write_report


def launch_study(
    settings: DictConfig,
    methods: Sequence[DictConfig],
    folder: Path,
    progress: bool,
    figures: bool,
) -> None:
    """Run a study, or what is left of it, print its table and write its report.

    Exits with status 1 if shards failed, and with 130 if it was interrupted.

    Args:
        settings: ``workers`` and ``every``, see :func:`run_study`.
        methods: one configuration per method, with its label.
        folder: the study's own.
        progress: show progress in a terminal.
        figures: draw the figures of the report.
    """
    try:
        with _interrupted_by(signal.SIGTERM):
            outcome = run_study(folder, methods, settings.workers, settings.every, progress)
    except KeyboardInterrupt:
        print(
            f"afm-rl: interrupted; the same command goes on from here (hydra.run.dir={folder})",
            file=sys.stderr,
        )
        sys.exit(130)
    if len(outcome.missions):
        print_summary(outcome.missions, outcome.measures)
        write_report([folder], folder / "report", figures=figures, load_track=load_track)
    print(f"Results: {folder}")
    for shard, reason in outcome.failures.items():
        print(f"afm-rl: {shard}: failed: {reason}", file=sys.stderr)
    if outcome.failures:
        print(
            f"afm-rl: {len(outcome.failures)} shards failed (shards/*/*/error.txt); the same "
            "command tries them again",
            file=sys.stderr,
        )
        sys.exit(1)


@contextmanager
def _interrupted_by(number: signal.Signals) -> Iterator[None]:
    """Treat a signal like Ctrl-C: batch systems send it before they kill."""
    before = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(number, before)
