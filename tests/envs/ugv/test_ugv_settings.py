"""Every setting of the environment is checked where it is given."""

import math

import pytest
import torch
from tensordict import TensorDict

from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, Regime


class Narrow(Regime):
    """Returns one component less than it was given."""

    names = ("gain",)
    identity = (1.0,)

    def apply(self, action, parameters, state, past=None, noise=None):
        return action[..., :1] * parameters

    def sample(self, shape, generator=None):
        return torch.ones(*shape, 1)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("tracks", "ethz_9"),
        ("tracks", ["ethz_1", "ethz_1"]),
        ("regime", ActionGain(["a", "b", "c"])),
        ("regime", Narrow()),
        ("schedule", [0.1, 0.2]),
        ("action_low", (2.0, -1.0)),
        ("action_low", 1.0),
        ("action_high", (1.0, math.inf)),
        ("batch_size", (0,)),
        ("missions", TensorDict({}, [])),
        ("missions", {"trak": "ethz_2"}),
        ("dtype", torch.int64),
    ],
)
def test_a_setting_out_of_range_is_named(setting, value):
    with pytest.raises(ConfigurationError, match=f"{setting}|give one name for each"):
        UGVTrack(**{setting: value})


def test_missions_have_to_broadcast():
    missions = UGVTrack().mission().expand(3)
    with pytest.raises(ConfigurationError, match="does not broadcast"):
        UGVTrack(batch_size=(2,), missions=missions)
    with pytest.raises(ConfigurationError, match="does not broadcast"):
        UGVTrack(missions=missions)


def test_a_locked_batch_begins_as_an_open_one():
    missions = UGVTrack().mission(seed=3, regime={"v_gain": -1.0}).expand(2)
    free, locked = UGVTrack(), UGVTrack(batch_size=(2,), missions=missions)
    assert (free.batch_locked, locked.batch_locked) == (False, True)
    assert (locked.reset() == free.reset(missions, set_state=False)).all()
