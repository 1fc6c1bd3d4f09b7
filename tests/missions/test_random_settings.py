"""Whatever a setting is changed to, a run is built, or refused with a reason."""

import copy
import random

import pytest
from harness import composed, shrink
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from afm_rl.errors import AFMError
from afm_rl.missions import build

METHODS = (
    *("method=afm_physics", "method=online_pe", "method=rls"),
    "robot=quadrotor method=online_knode",
)
CHANGES = 40  # of each method
VALUES = """
0 1 -1 2 3 0.5 -0.0 1e-300 1e300 1e400 -1e30 nan inf -inf 99999999999999999999 2147483648 true
false null none all abc "" "../../x" ".." "/" [] [0] [1,2] [[]] [null] [nan,inf] [x,x,x] {} {a:1}
[1e30,-1e30] {v_gain:1e30} [{}] [{v_gain:-1}] [{saturation:0}] [[{},{}]] {_target_:os.system}
[-1,0,1] [a,b,c] cuda:7
""".split()


def leaves(node, place=""):
    """Name every setting, also those that hold others."""
    for key, value in node.items():
        where = f"{place}.{key}" if place else str(key)
        yield where
        if isinstance(value, dict):
            yield from leaves(value, where)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("method", METHODS)
def test_random_settings_end_in_a_run_or_in_one_line(no_training, method):
    dice, parse = random.Random(method), OverridesParser.create().parse_override
    base = shrink(copy.deepcopy(composed(*method.split())))
    keys = sorted(leaves(OmegaConf.to_container(base, resolve=False)))
    refused = built = 0
    for _ in range(CHANGES):
        cfg = copy.deepcopy(base)
        change = f"{dice.choice(keys)}={dice.choice(VALUES)}"
        try:
            override = parse(change)
            OmegaConf.update(cfg, override.key_or_group, override.value(), merge=False)
            build(cfg)
            built += 1
        except (AFMError, HydraException, OmegaConfBaseException) as error:
            assert str(error).strip(), change
            refused += 1
        except Exception as error:
            raise AssertionError(f"{change}: {error!r}") from error
    assert refused > CHANGES / 3 and built, (refused, built)
