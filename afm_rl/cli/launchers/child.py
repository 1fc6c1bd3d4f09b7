"""The process of a job: ``python -m afm_rl.cli.launchers.child FOLDER DIGEST ARGUMENT...``."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from pathlib import Path

from afm_rl import cli
from afm_rl.cli.error_messages import explain, one_line
from afm_rl.cli.launchers.job import FINISHED, SAYS


def main() -> None:
    """Run ``afm-rl`` in the folder of a job, and leave a mark there when all is done."""
    folder, digest, *arguments = sys.argv[1:]
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[1:] = [*arguments, f"hydra.run.dir={quoted(folder)}", "hydra.mode=RUN"]
    try:
        _work(Path(folder), digest)
    except Exception as error:
        traceback.print_exc()
        reason = explain(error) or one_line(f"{type(error).__name__}: {error}").rstrip(": ")
        sys.exit(f"{SAYS}{reason}")


def _work(folder: Path, digest: str) -> None:
    from afm_rl.artefacts import write_whole
    from afm_rl.missions.lock import locked
    from afm_rl.missions.shard import MISSIONS

    with locked(folder / ".job"):  # a study locks the folder itself
        (folder / MISSIONS).unlink(missing_ok=True)  # of an attempt that did not get to the end
        cli.main()
        write_whole(folder / FINISHED, f"{digest}\n".encode())


def _end_with_parent() -> None:
    """Wait for the end of standard input, which the parent holds open; then stop."""
    os.read(0, 1)  # nobody writes there
    os.kill(os.getpid(), signal.SIGTERM)


def quoted(text: str) -> str:
    r"""Return a text so that Hydra takes it for what it is.

    >>> print(quoted("it's a,b"))
    'it\'s a,b'
    """
    return "'" + text.replace("'", r"\'") + "'"


if __name__ == "__main__":
    main()
