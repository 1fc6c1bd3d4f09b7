"""Whoever uses the library and whoever uses the command line get the same settings."""

import inspect
from pathlib import Path

import pytest
import yaml

import afm_rl.conf
from afm_rl.missions.build import DEFAULTS
from afm_rl.options import options_of, parts_of
from afm_rl.trust import find_code

CONF = Path(afm_rl.conf.__file__).parent
VARIANTS = {  # choices that are there because they differ
    *("planner/mppi_paper", "corrector/adaptive_affine", "dynamics/pe_stream_x"),
    *("dynamics/pe_dr", "updater/rls_unmatched", "cost/goal_pose"),
}
OF_THE_ROBOT = ("seed_key", "bounds_key", "bounded", "rest", "frame")  # what not every robot has
FILES = [
    path
    for group in ("planner", "cost", "dynamics", "updater", "corrector")
    for path in sorted((CONF / group).glob("*.yaml"))
    if f"{group}/{path.stem}" not in VARIANTS and "_target_" in path.read_text()
]


def differing(target, settings):
    """Yield name, value and default of the options that a file sets to something else."""
    known = options_of(target)
    for name, value in settings.items():
        if name == "pretrain" and value:
            yield from differing(parts_of(target)[name], value)
        elif name in known and name not in OF_THE_ROBOT and "${" not in str(value):
            default = known[name].default
            default = list(default) if isinstance(default, tuple) else default
            if value != default and default is not inspect.Parameter.empty:
                yield name, value, default


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_defaults_of_the_command_line_are_those_of_the_library(path):
    settings = yaml.safe_load(path.read_text())
    assert list(differing(find_code("_target_", settings["_target_"]), settings)) == []


def test_what_a_configuration_may_leave_out_has_the_values_of_ours():
    ours = yaml.safe_load((CONF / "config.yaml").read_text())
    assert {name: ours[name] for name in DEFAULTS} == DEFAULTS
