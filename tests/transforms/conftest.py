"""One fixture for all shells."""

import pytest
from shells import SHELLS, by_tier


@pytest.fixture(params=by_tier(SHELLS))
def shell(request):
    """Run plans in a shell around pucks, whose actuators are reversed; yield what is executed."""
    return SHELLS[request.param]
