"""Packages that a command trusts: their code may be called, and their settings chosen."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from afm_rl.targets import check_composed
from afm_rl.trust import check_trust, conf_folders, trusted, trusting


class TrustedFolders(SearchPathPlugin):
    """Lets Hydra find the settings of trusted packages, after those of this library."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in conf_folders():
            search_path.append("trust", f"file://{folder}")


def trusted_packages(arguments: Sequence[str]) -> list[str]:
    """Return the packages that the command line itself trusts; files cannot.

    Raises:
        ConfigurationError: if these are no names.

    >>> trusted_packages(["method=physics", "trust=[mine, my.models]"])
    ['mine', 'my.models']
    """
    given = [text for text in arguments if re.match(r"\+{0,2}trust=", text)]
    found = [each.value() for each in OverridesParser.create().parse_overrides(given)]
    return [name for names in found for name in check_trust(names)]


@contextmanager
def checked(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Let Hydra compose what a command asks for, and check it before anything in it is called.

    Yields:
        The packages that the command trusts.

    Raises:
        ConfigurationError: for a package that cannot be found, and for code that is not trusted.
    """
    load = ConfigLoaderImpl.load_configuration

    @functools.wraps(load)
    def checking(*args: Any, **kwargs: Any) -> DictConfig:
        cfg = load(*args, **kwargs)
        settings: Any = OmegaConf.to_container(cfg, resolve=False)
        check_composed(settings, trusted())
        return cfg

    names = trusted_packages(arguments)
    with trusting(names):
        conf_folders()  # an error of a package is told here, not as one of Hydra's
        Plugins.instance().register(TrustedFolders)
        ConfigLoaderImpl.load_configuration = checking  # type: ignore[method-assign]
        try:
            yield names
        finally:
            ConfigLoaderImpl.load_configuration = load  # type: ignore[method-assign]
