"""Old names lead to the new ones, and warn whoever uses them, where they are used."""

from importlib import import_module

import pytest
import torch

from afm_rl.correction import ActionFlow
from afm_rl.deprecated import NAMES


@pytest.mark.parametrize(("old", "new"), NAMES.items())
def test_an_old_name_is_the_new_one(old, new):
    module, _, name = old.rpartition(".")
    with pytest.warns(DeprecationWarning, match=f"{old} is called {new} now"):
        part = getattr(import_module(module), name)
    module, _, name = new.rpartition(".")
    assert part is getattr(import_module(module), name)


@pytest.mark.parametrize(
    "line", ["from afm_rl.envs import Table", "ActionFlow(-one, one, readings=['recent'])"]
)
def test_the_warning_is_about_the_line_that_uses_it(line):
    with pytest.warns(DeprecationWarning, match="now; the old name") as caught:
        exec(
            compile(line, "a_program.py", "exec"), {"ActionFlow": ActionFlow, "one": torch.ones(1)}
        )
    assert {warning.filename for warning in caught} == {"a_program.py"}
