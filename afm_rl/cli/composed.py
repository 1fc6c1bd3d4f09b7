"""What files may tell Hydra, which acts on some settings before this library is asked.

Environment, launchers, loggers, callbacks and folders of settings are Hydra's: with them a file
could run code. So a file may set of these what :data:`FREE` says; all else counts on the command
line only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from afm_rl.errors import ConfigurationError, printable
from afm_rl.trust import check_name, find_code, leaves

CALLED = ("hydra.callbacks", "hydra.launcher", "hydra.sweeper", "hydra.job.env_set")
"""What Hydra calls, or sets."""
GUARDED = re.compile(
    r"overwrite|hydra\.(launcher|output_subdir|(job|hydra)_logging|job\.(chdir|name|env_set))(\..*)?",
    re.DOTALL,
)
"""What a file may set only as :data:`FREE` says."""
FREE = re.compile(
    r"""overwrite=False | hydra\.(output_subdir=\.hydra | job\.(chdir=False | name=[\w.-]+))
    | hydra\.job\.env_set\.(
        (OMP|MKL|OPENBLAS|NUMEXPR)_NUM_THREADS | CUDA_(VISIBLE_DEVICES|DEVICE_ORDER|LAUNCH_BLOCKING)
        | CUBLAS_WORKSPACE_CONFIG | MUJOCO_GL
      )=[\w:,-]*
    | hydra\.launcher\.(
        _target_=[\w.]+ | (executor|cluster|n_jobs|grace|num_cpus|num_gpus)=[\w.-]*
        | parameters\.(
            name | timeout_min | mem_gb | (cpus|gpus)_per_(task|node)
            | slurm_(partition|account|qos|constraint|gres|time|array_parallelism|signal_delay_s)
          )=[ -~\w]*
      )
    | hydra\.(job|hydra)_logging\.(
        (version|disable_existing_loggers)=\w+ | (root|loggers)\.[\w.-]+=[\w.]*
        | formatters\.\w+\.format=([][()|/.:, -]|HYDRA|%\(\w+\)[-\d.]*[sdf])*
        | formatters\.\w+\.datefmt=([:,./ -]|%\w)*
        | handlers\.\w+\.(
            (level|formatter)=\w+ | class=logging\.StreamHandler | stream=ext://sys\.std(out|err)
          )
      )
    | hydra\.job_logging\.handlers\.\w+\.(
        class=logging\.FileHandler | (mode|encoding|delay)=[\w-]+
        | filename=\$\{hydra\.runtime\.output_dir\}/([\w.-]+|\$\{hydra\.job\.name\})\.log
      )""",
    re.VERBOSE,
)
"""Names and values that do no harm. Formats of logs hold no words, which a shell could read."""
PLUGINS = (
    "hydra_plugins.afm_rl.JobLauncher",
    "hydra._internal.core_plugins.basic_launcher.BasicLauncher",
    "hydra._internal.core_plugins.basic_sweeper.BasicSweeper",
)
"""Launchers and the sweeper that need no trust."""


def given_by(arguments: Sequence[str]) -> dict[str, Any]:
    """Return what a command line sets itself, by place.

    >>> given_by(["-m", "seeds=1,2", "+hydra.launcher.parameters={slurm_setup: [module load x]}"])
    {'hydra.launcher.parameters.slurm_setup.0': 'module load x'}
    """
    texts = [text for text in arguments if re.match(r"\+{0,2}(hydra[.=]|overwrite=)", text)]
    given = {}
    for each in OverridesParser.create().parse_overrides(texts):
        given.update(
            {place: value for place, _, value in leaves({each.key_or_group: each.value()})}
        )
    return given


def check_sources(config: Any) -> None:
    """Check where a file looks for other ones: a package that is named there is imported.

    Raises:
        ConfigurationError: for a package that is not trusted.
    """
    for path in OmegaConf.select(config, "hydra.searchpath") or ():
        scheme, _, package = str(path).partition("://")
        package = package.replace("/", ".")
        if scheme == "pkg" and package.strip(".") not in ("afm_rl.conf", "hydra.conf"):
            check_name("hydra.searchpath", package)


def check_composed(cfg: DictConfig, overrides: Sequence[str], given: Mapping[str, Any]) -> None:
    """Check what Hydra composed, before it acts on it or calls anything in it.

    What Hydra calls is resolved in place, so that it stays what was checked.

    Args:
        cfg: settings, with Hydra's own.
        overrides: that they were composed with.
        given: what the command line sets itself, by place.

    Raises:
        ConfigurationError: naming the setting.
    """
    written = {place: value for place, _, value in leaves(OmegaConf.to_container(cfg))}
    for place in CALLED:
        node = OmegaConf.select(cfg, place)
        if OmegaConf.is_config(node):
            with open_dict(cfg.hydra):
                fixed = OmegaConf.to_container(node, resolve=True)
                OmegaConf.update(cfg, place, fixed, merge=False)
    settings: Any = OmegaConf.to_container(cfg)
    own = settings["hydra"]
    launcher = own["launcher"].get("_target_") if isinstance(own["launcher"], Mapping) else None
    for place, key, value in leaves(settings):
        called, text = place.startswith(CALLED), isinstance(value, str)
        if called and text and "${" in value:
            raise ConfigurationError(f"{place}={value!r}: expected a value")
        plugged = place in ("hydra.launcher._target_", "hydra.sweeper._target_")
        if key == "_target_" and not (plugged and value in PLUGINS):
            if called:
                find_code(place, value)
            elif not (text and "${" in value):  # else it is judged once it is known
                check_name(place, value)
        trusted = place.startswith("hydra.launcher.") and launcher not in (None, *PLUGINS)
        if trusted or value in (None, "???") or not GUARDED.fullmatch(place):
            continue
        if place in given and given[place] == written.get(place):
            continue
        if not FREE.fullmatch(f"{place}={value}"):
            raise ConfigurationError(
                f"{printable(place)}={value!r}: a file may not set this; it counts on the command "
                "line only"
            )
    if sorted([*own["overrides"]["task"], *own["overrides"]["hydra"]]) != sorted(overrides):
        raise ConfigurationError("hydra.overrides: a file may not add to the command line")
    _check_links(cfg)


def _check_links(cfg: DictConfig) -> None:
    """Check that what Hydra writes into its folders stays there."""
    # Patterns, which links to nothing match, too.
    inside = ("multirun.yam[l]", "*.log", ".hydr[a]", ".hydr[a]/*")
    written = (*inside, *(f"*/{pattern}" for pattern in inside[1:]))
    for place in ("hydra.run.dir", "hydra.sweep.dir"):
        with suppress(OmegaConfBaseException):  # a folder that is known only later is a new one
            folder = Path(str(OmegaConf.select(cfg, place)))
            for path in chain.from_iterable(map(folder.glob, written)):
                if path.is_symlink():
                    raise ConfigurationError(f"{place}={folder}: {path} is a link; remove it")
