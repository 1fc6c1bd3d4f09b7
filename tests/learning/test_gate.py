"""The gate over a learned model: false alarms at the chosen rate."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError, NonFiniteError
from afm_rl.learning import fit_gate, largest_innovation


def healthy(transitions, count, seed):
    state, action = transitions(4, count, seed=seed)
    found = TensorDict({"observation": state, "action": action}, [4, count])
    return found.set(("next", "observation"), Dubins()(state, action))


def alarms(corrector, model, data):
    """Return the share of steps at which the gate would be open."""
    parts = data["observation"], data["action"], data["next", "observation"]
    innovation = largest_innovation(model, *parts)
    newest = innovation.unfold(-1, corrector.recent, 1).amax(-1)
    return float((newest > corrector.gate).float().mean())


@pytest.mark.parametrize("recent", [1, 12])
@pytest.mark.parametrize("rate", [0.01, 0.1])
def test_false_alarms_come_at_the_chosen_rate(trained_ensemble, transitions, recent, rate):
    corrector = SimpleNamespace(gate=0.1, recent=recent)
    before = alarms(corrector, trained_ensemble, healthy(transitions, 5000, 3))
    gate = fit_gate(corrector, trained_ensemble, healthy(transitions, 5000, 3), rate)
    assert gate == corrector.gate
    after = alarms(corrector, trained_ensemble, healthy(transitions, 5000, 4))
    assert 0.5 * rate < after < 2 * rate
    assert rate < before


def test_keys_may_be_others(trained_ensemble, transitions):
    data, corrector = healthy(transitions, 500, 0), SimpleNamespace(gate=1.0)
    expected = fit_gate(corrector, trained_ensemble, data)
    named = TensorDict({"s": data["observation"], "a": data["action"]}, data.batch_size)
    named["t"] = data["next", "observation"].double()
    assert fit_gate(corrector, trained_ensemble, named, keys=("s", "a", "t")) == pytest.approx(
        expected, rel=1e-3
    )


def test_data_that_cannot_be_used(trained_ensemble, transitions):
    corrector = SimpleNamespace(gate=1.0, recent=12)
    with pytest.raises(ConfigurationError, match="at least 1000 windows of 12 .*, got 4"):
        fit_gate(corrector, trained_ensemble, healthy(transitions, 12, 0), 0.001)
    with pytest.raises(ConfigurationError, match="at least 12 steps"):
        fit_gate(corrector, trained_ensemble, healthy(transitions, 3, 0))
    with pytest.raises(ConfigurationError, match="false_alarms=0"):
        fit_gate(corrector, trained_ensemble, healthy(transitions, 50, 0), 0.0)
    data = healthy(transitions, 500, 0)
    data["next", "observation"][0, 7] = torch.inf
    with pytest.raises(NonFiniteError):
        fit_gate(corrector, trained_ensemble, data)
    assert corrector.gate == 1.0
