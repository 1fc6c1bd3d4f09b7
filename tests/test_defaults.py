"""Whoever uses the library and whoever uses the command line get the same settings."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import afm_rl.conf
from afm_rl.missions import factories as made
from afm_rl.missions.build import DEFAULTS

CONF = Path(afm_rl.conf.__file__).parent
MAKES = {  # what a factory hands its settings to
    "ensemble": "afm_rl.dynamics.Ensemble",
    "knode": "afm_rl.dynamics.KNODE",
    "afm": "afm_rl.correction.ActionFlow",
    "paper_flow": "afm_rl.correction.PaperFlow",
    "least_squares": "afm_rl.correction.LeastSquares",
    "l1": "afm_rl.correction.L1Augmentation",
}
TRAINS = {
    "ensemble": ("pretrain", made.pretrain_ensemble),
    "knode": ("pretrain", made.pretrain_knode),
}
VARIANTS = {  # choices that are there because they differ
    *("planner/mppi_paper", "corrector/adaptive_affine", "dynamics/pe_stream_x"),
    *("updater/stream_x_literal", "dynamics/pe_dr", "updater/rls_unmatched", "cost/goal_pose"),
}
OF_THE_ROBOT = ("seed_key", "box_key", "bounded", "rest", "frame")  # what not every robot has
GROUPS = ("planner", "cost", "dynamics", "updater", "corrector")
FILES = [
    path
    for group in GROUPS
    for path in sorted((CONF / group).glob("*.yaml"))
    if f"{group}/{path.stem}" not in VARIANTS and "_target_" in path.read_text()
]


def find(target):
    module, _, name = target.rpartition(".")
    return getattr(import_module(module), name)


def defaults(function):
    return {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }


def plain(value):
    if isinstance(value, tuple | list):
        return [plain(part) for part in value]
    return value


def compared(path):
    """Yield name, value in the file, and default."""
    settings = yaml.safe_load(path.read_text())
    target = find(settings["_target_"])
    known = defaults(target)
    made_by = settings["_target_"].rpartition(".")[2]
    if made_by in MAKES:
        known = {**defaults(find(MAKES[made_by])), **known}
    given = {name: value for name, value in settings.items() if name not in OF_THE_ROBOT}
    if made_by in TRAINS and given.get(TRAINS[made_by][0]):
        inner, function = TRAINS[made_by]
        own = defaults(function)
        yield from ((f"{inner}.{k}", v, own[k]) for k, v in given.pop(inner).items() if k in own)
    yield from ((name, value, known[name]) for name, value in given.items() if name in known)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_defaults_of_the_command_line_are_those_of_the_library(path):
    differ = {
        name: (value, default)
        for name, value, default in compared(path)
        if plain(value) != plain(default) and "${" not in str(value)
    }
    assert differ == {}


def test_what_a_configuration_may_leave_out_has_the_values_of_ours():
    ours = yaml.safe_load((CONF / "config.yaml").read_text())
    assert {name: ours[name] for name in DEFAULTS} == DEFAULTS
