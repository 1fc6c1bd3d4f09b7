"""The command line."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from afm_rl._version import __version__
from afm_rl.cli.error_messages import explain, one_line
from afm_rl.cli.launchers import register
from afm_rl.cli.launchers.base import JobsFailed
from afm_rl.cli.overrides import relaxed, trusted_packages, with_sweep_folder
from afm_rl.trust import TRUST, check_composed, trusted

_launched: list[bool] = []
"""Whether Hydra is done with the settings."""


@hydra.main(version_base="1.3", config_path="pkg://afm_rl.conf", config_name="config")
def _run(cfg: DictConfig) -> None:
    _launched.append(True)
    from afm_rl.cli.launch import launch  # torch takes seconds: `--help` need not wait for it

    sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    with _explained(sweep):  # here, so that Hydra does not report the error once more
        launch(cfg)


@contextmanager
def _explained(sweep: bool = False) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:  # nobody reads on, as in `afm-rl --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        message = explain(error)
        if message is None and not _launched:  # what Hydra makes of settings
            message = one_line(f"settings: {error}" if str(error) else f"settings: {error!r}")
        if message is None:
            raise
        print(f"afm-rl: {message}", file=sys.stderr)
        if sweep:
            raise  # the other jobs go on; Hydra raises the first error again at the end
        sys.exit(1 if isinstance(error, JobsFailed) else 2)


@contextmanager
def _checked(trust: Sequence[str]) -> Iterator[None]:
    """Check what Hydra composes, before it calls anything that is named there."""
    load, before = ConfigLoaderImpl.load_configuration, os.environ.get(TRUST)

    @functools.wraps(load)
    def checked(*args: Any, **kwargs: Any) -> DictConfig:
        cfg = load(*args, **kwargs)
        settings: Any = OmegaConf.to_container(cfg, resolve=False)
        check_composed(settings, trusted())
        return cfg

    os.environ[TRUST] = ",".join([*trusted(), *trust])  # for processes that this one starts
    ConfigLoaderImpl.load_configuration = checked  # type: ignore[method-assign]
    try:
        yield
    finally:
        ConfigLoaderImpl.load_configuration = load  # type: ignore[method-assign]
        os.environ.pop(TRUST)
        os.environ.update({} if before is None else {TRUST: before})


def main() -> None:
    """Run ``afm-rl``; a mistake in the settings ends in one line and exit status 2."""
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # hand errors to us instead of printing them
    if sys.argv[1:] == ["--version"]:
        print(f"afm-rl {__version__}")
        return
    _launched.clear()
    sys.argv[1:] = with_sweep_folder(relaxed(sys.argv[1:]))
    with _explained(), _checked(trusted_packages(sys.argv[1:])):
        register()
        _run()
