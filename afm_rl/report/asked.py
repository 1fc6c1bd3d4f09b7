"""What a study was to run."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from afm_rl.errors import ConfigurationError

KEY = ["method", "cell", "seed"]


def asked_for(folder: Path, missions: pd.DataFrame) -> pd.DataFrame:
    """Return what the study in a folder was to run: ``method``, ``cell`` and ``seed``.

    ``study.yaml`` names ``methods`` (a list, or a mapping by name), ``seeds`` (a count or a
    list) and, if it likes, ``cells`` (a list of names in words); where it names none, they are
    those of the missions.

    Args:
        folder: of a study; one without ``study.yaml`` asked for nothing.
        missions: what is finished, with ``cell``.

    Raises:
        ConfigurationError: if ``study.yaml`` cannot be read, or names no methods and seeds.
    """
    path = Path(folder) / "study.yaml"
    if not path.is_file():
        return pd.DataFrame(columns=KEY)
    try:
        study = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OmegaConfBaseException, YAMLError, OSError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error
    if not isinstance(study, dict) or not {"methods", "seeds"} <= set(study):
        raise ConfigurationError(f"{path}: expected the entries methods and seeds")
    methods, seeds = _names(study["methods"]), study["seeds"]
    numbers = range(seeds) if isinstance(seeds, int) else seeds
    cells = _names(study.get("cells") or []) or list(missions["cell"].unique())
    return pd.DataFrame(product(methods, cells, numbers), columns=KEY)


def _names(entries: Any) -> list[str]:
    return [str(name) for name in entries]
