"""One job, in a process of its own.

Imported wherever a job is waited for: without torch.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.context import ForkServerProcess, SpawnProcess
from pathlib import Path
from typing import Any

from afm_rl.errors import AFMError, causes
from afm_rl.jobs.layout import LOG, is_finished
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import CONFIG, UNFINISHED
from afm_rl.trust import trust

START = "forkserver"  # torch is imported once, and jobs are forked from there
FAILURE, PROGRESS = "failure.txt", "progress.txt"  # in the folder of unfinished results
Process = ForkServerProcess | SpawnProcess


@dataclass(frozen=True)
class Job:
    """A run that is one of several.

    Args:
        name: what sets it apart from the others.
        folder: its own.
        cwd: where the command was given, which relative paths are relative to.
        trust: packages that the command trusts, see :mod:`afm_rl.trust`.
    """

    name: str
    folder: Path
    cwd: Path
    trust: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.name


def start(job: Job) -> Process:
    """Start the process of a job. It ends, with a checkpoint, when this process ends."""
    for name in (FAILURE, PROGRESS):  # of an earlier attempt
        (job.folder / UNFINISHED / name).unlink(missing_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context: Any = multiprocessing.get_context(START)  # every kind has processes
    if START == "forkserver":
        context.set_forkserver_preload(["afm_rl.jobs.preload", "afm_rl.envs"])
    process = context.Process(target=work, args=(job,), name=job.name, daemon=True)
    process.start()
    return process


def is_done(job: Job) -> bool:
    """Return whether a job has its results."""
    return is_finished(job.folder) and not (job.folder / UNFINISHED / CONFIG).exists()


def said(job: Job) -> str:
    """Return why a job has no results, as it said itself; "" if it could not."""
    path = job.folder / UNFINISHED / FAILURE
    return path.read_text() if path.exists() else ""


def last_words(status: int) -> str:
    """Say how a process ended.

    >>> last_words(-9)
    'its process was ended by SIGKILL; was there enough memory?'
    >>> last_words(3)
    'its process ended with status 3 before its results were complete'
    """
    if status >= 0:
        return f"its process ended with status {status} before its results were complete"
    hint = "; was there enough memory?" if status == -signal.SIGKILL else ""
    return f"its process was ended by {signal.Signals(-status).name}{hint}"


def work(job: Job) -> None:
    """Finish a job: the main function of its process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent decides
    (job.folder / LOG).unlink(missing_ok=True)  # it may be a link
    log = open(job.folder / LOG, "w", buffering=1)  # open as long as the process lives
    for number in (1, 2):
        os.dup2(log.fileno(), number)
    sys.stdout = sys.stderr = log
    os.chdir(job.cwd)
    trust(job.trust)
    try:
        _finish(job)
    except KeyboardInterrupt:  # told to stop
        return
    except BaseException as error:
        traceback.print_exc()
        with suppress(OSError):
            (job.folder / UNFINISHED / FAILURE).write_text(explain(error))
        sys.exit(1)


def _finish(job: Job) -> None:
    from afm_rl.jobs.run import TENSORBOARD, Stop, finish
    from afm_rl.missions.run import Stopped
    from afm_rl.progress import Bar

    def report(share: float) -> None:
        part = path.with_suffix(".part")
        with suppress(OSError):  # such as a full disk: the missions matter more
            part.write_text(str(share))
            os.replace(part, path)

    path, stop = job.folder / UNFINISHED / PROGRESS, Stop()
    curves = job.folder.parents[1] / TENSORBOARD / job.folder.name  # beside those of other jobs
    with handled(stop, signal.SIGTERM), locked(job.folder, wait=True):
        # The lock: an orphan of a command that was killed may be in its last step.
        threading.Thread(target=_end_with_parent, daemon=True).start()
        Bar.listener = report
        report(0.0)
        try:
            finish(job.folder, stop=stop, curves=curves)
        except Stopped:
            return


@contextmanager
def handled(handler: Any, *numbers: signal.Signals) -> Iterator[None]:
    """Have a handler called when one of these signals arrives."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def explain(error: BaseException) -> str:
    """Return a message of one line about an error.

    >>> explain(ZeroDivisionError("division by zero"))
    'ZeroDivisionError: division by zero'
    """
    cause = next((part for part in causes(error) if isinstance(part, AFMError)), None)
    text = str(cause) if cause else f"{type(error).__name__}: {error}".removesuffix(": ")
    return " ".join(text.split())
