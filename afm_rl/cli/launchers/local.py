"""Jobs on this machine."""

from __future__ import annotations

from afm_rl.cli.launchers.base import JobLauncher
from afm_rl.jobs.local import LocalPool


class LocalLauncher(LocalPool, JobLauncher):
    """Runs some jobs at a time on this machine, see :class:`afm_rl.jobs.local.LocalPool`."""
