"""Settings files, as Hydra reads them.

Hydra's environment, launchers, loggers, callbacks and search paths could run code before this
library is asked. So a settings file that the command line does not trust by name must not have a
key ``hydra``: settings of Hydra count on the command line, and in the folders ``conf`` of trusted
packages.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from afm_rl.errors import ConfigurationError
from afm_rl.storage.files import check_yaml
from afm_rl.trust import conf_folders

LARGEST = 2**16  # bytes of a settings file; reading them takes two seconds


class TrustedFolders(SearchPathPlugin):
    """Lets Hydra find the settings of trusted packages, after those of this library."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in conf_folders():
            search_path.append("trust", f"file://{folder}")


class CheckedFiles(FileConfigSource):
    """Files of a folder: without aliases, and with nothing about Hydra if it is not trusted."""

    def load_config(self, config_path: str) -> ConfigResult:
        path = Path(self.path, self._normalize_file_name(config_path)).resolve()
        if path.is_file():
            with path.open("rb") as file:
                text = file.read(LARGEST + 1)
            if len(text) > LARGEST:
                raise ConfigurationError(f"{path}: expected {LARGEST} bytes at most")
            try:
                check_yaml(text.decode(), yaml.SafeLoader)  # Hydra's own is one
            except (yaml.YAMLError, ValueError) as error:
                raise ConfigurationError(f"{path}: {error}") from error
        result = super().load_config(config_path)
        if not any(path.is_relative_to(folder.resolve()) for folder in conf_folders()):
            settings: Any = OmegaConf.to_container(result.config)
            defaults = settings.get("defaults") if isinstance(settings, dict) else None
            # The places of what it holds, and of what it includes.
            places = [config_path, result.header["package"], *settings, *(defaults or ())]
            if any(re.search(r"\bhydra\b", str(place)) for place in places):
                raise ConfigurationError(
                    f"{path}: a settings file must not have a key hydra; give it on the command "
                    "line, or in the folder conf of a package that you trust (trust=[PACKAGE])"
                )
        return result


# Hydra registers its class again in the workers of its joblib launcher, and compares names.
CheckedFiles.__name__ = FileConfigSource.__name__


@contextmanager
def checked_files() -> Iterator[None]:
    """Let Hydra read files by :class:`CheckedFiles`, and those of trusted packages, for a while."""
    conf_folders()  # reports an error of a package here, not as one of Hydra's
    Plugins.instance().register(TrustedFolders)
    sources = SourcesRegistry.instance().types
    before = sources["file"]
    sources["file"] = CheckedFiles
    try:
        yield
    finally:
        sources["file"] = before


def check_links(folders: Iterable[str]) -> None:
    """Check that what Hydra writes into folders stays there.

    Raises:
        ConfigurationError: naming a link.
    """
    # Patterns, which links to nothing match, too.
    inside = ("multirun.yam[l]", "*.log", ".hydr[a]", ".hydr[a]/*")
    written = (*inside, *(f"*/{pattern}" for pattern in inside[1:]))
    for folder in folders:
        for path in chain.from_iterable(map(Path(folder).glob, written)):
            if path.is_symlink():
                raise ConfigurationError(f"{folder}: {path} is a link; remove it")
