"""The command line."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from afm_rl import conf
from afm_rl._version import __version__
from afm_rl.cli.error_messages import errors_in_one_line
from afm_rl.cli.launcher import register
from afm_rl.cli.overrides import checked, named_packages, relaxed, with_sweep_folder
from afm_rl.imports import RUN, check_installed, without_collection
from afm_rl.trust import trusting

_launched: list[bool] = []
"""Whether Hydra is done with the settings."""


@hydra.main(version_base="1.3", config_path="pkg://afm_rl.conf", config_name="config")
def _run(cfg: DictConfig) -> float:
    _launched.append(True)
    # The other jobs of a sweep go on; Hydra raises the first error again at the end.
    sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    # Here, so that Hydra does not report the error once more.
    with errors_in_one_line("afm-rl", again=sweep):
        check_installed("missions", *RUN)
        with without_collection():  # torch takes seconds: `--help` need not wait for it
            from afm_rl.cli.launch import launch

        # In the workers of Hydra's launchers, too.
        with trusting(named_packages(HydraConfig.get().overrides.task)):
            return launch(cfg)


def _chosen(arguments: list[str]) -> list[Path]:
    """Return the settings files of choices, group=choice; their comments say what options are."""
    paths = [Path(conf.__path__[0], f"{text.replace('=', '/', 1)}.yaml") for text in arguments]
    return [path for path in paths if path.is_file()]


def main() -> None:
    """Run ``afm-rl``; a wrong setting ends with one line of text and status 2."""
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # hand errors to us instead of printing them
    if sys.argv[1:] == ["--version"]:
        print(f"afm-rl {__version__}")
        return
    if {"-h", "--help"} & {*sys.argv[1:]} and (files := _chosen(sys.argv[1:])):
        print(*(path.read_text(encoding="utf-8") for path in files), sep="\n", end="")
        return
    _launched.clear()
    sys.argv[1:] = with_sweep_folder(relaxed(sys.argv[1:]))
    with errors_in_one_line("afm-rl", _launched), checked(sys.argv[1:]):
        register()
        _run()
