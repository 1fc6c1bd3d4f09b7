"""One fixture for all shells."""

import pytest
from shells import SHELLS

FIRST = ("transform", "wrapper")  # what `make test` tries; `make check` tries all


@pytest.fixture(
    params=[pytest.param(k, marks=[] if k in FIRST else pytest.mark.check) for k in SHELLS]
)
def shell(request):
    """Run plans in a shell around pucks, whose actuators are reversed; yield what is executed."""
    return SHELLS[request.param]
