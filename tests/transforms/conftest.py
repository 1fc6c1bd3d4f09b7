"""One fixture for all shells."""

import pytest
from shells import SHELLS


@pytest.fixture(params=SHELLS)
def shell(request):
    """Run plans in a shell around pucks, whose actuators are reversed; yield what is executed."""
    return SHELLS[request.param]
