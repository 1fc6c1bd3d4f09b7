"""What every flow promises."""

import copy
import math

import pytest
import torch

from afm_rl.artefacts import load_artefact, save_artefact
from afm_rl.dynamics import Quadrotor
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.flow import ContextFlow, PaperFlow
from afm_rl.regimes import MassFactor


@pytest.fixture
def flow(box):
    return ContextFlow(*box, window=3, hidden=[8], latent=4)


def test_actions_are_handled_in_half_ranges():
    flow = ContextFlow(torch.tensor([0.0, -1.0]), torch.tensor([4.0, 3.0]))
    corners = torch.tensor([[0.0, -1.0], [2.0, 1.0], [4.0, 3.0]])
    unit = flow.normalise(corners)
    assert unit.tolist() == [[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]]
    assert torch.equal(flow.denormalise(unit), corners)
    assert flow.action_size == 2


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([-1.0], [1.0, 1.0]),
        ([1.0], [-1.0]),
        ([1.0], [1.0]),
        ([math.nan], [1.0]),
        ([-math.inf], [1.0]),
        ([[-1.0]], [[1.0]]),
    ],
    ids=str,
)
def test_impossible_boxes_are_refused(low, high):
    with pytest.raises(ConfigurationError, match="flow: action bounds"):
        ContextFlow(torch.tensor(low), torch.tensor(high))


def test_only_weights_are_stored(flow):
    assert set(flow.state_dict()) == {name for name, _ in flow.named_parameters()}
    twin = copy.deepcopy(flow)
    twin.encoder[0].weight.data.zero_()
    assert flow.encoder[0].weight.abs().sum() > 0


def test_a_stored_flow_loads_where_it_fits(flow, box, tmp_path):
    path = tmp_path / "flow.safetensors"
    save_artefact(path, flow, flow.signature)
    twin = ContextFlow(*box, window=3, hidden=[8], latent=4, seed=5)
    load_artefact(path, twin, twin.signature)
    assert torch.equal(twin.encoder[0].weight, flow.encoder[0].weight)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda low, high: ContextFlow(low, high, window=4, hidden=[8], latent=4), "feature_size"),
        (lambda low, high: ContextFlow(low[:1], high[:1], window=3), "action_size"),
        (lambda low, high: PaperFlow(low, high, features=[2], state_size=3), "kind"),
        (lambda low, high: ContextFlow(low, high, window=3, hidden=[9], latent=4), "does not fit"),
    ],
    ids=["window", "action", "kind", "hidden"],
)
def test_a_stored_flow_is_refused_where_it_does_not_fit(flow, box, tmp_path, make, match):
    path = tmp_path / "flow.safetensors"
    save_artefact(path, flow, flow.signature)
    other = make(*box)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(ArtefactError, match=match):
        load_artefact(path, other, other.signature)
    for name, value in other.state_dict().items():
        assert torch.equal(value, before[name])


def test_training_states_lie_on_the_manifold(monkeypatch):
    seen = []
    forecast = Quadrotor.forecast

    def spy(model, state, action):
        seen.append(state)
        return forecast(model, state, action)

    monkeypatch.setattr(Quadrotor, "forecast", spy)
    low, high = torch.tensor([0.0, -1.0, -1.0, -1.0]), torch.ones(4)
    box = torch.zeros(13), torch.ones(13)
    for flow in (ContextFlow(low, high), PaperFlow(low, high, [3, 4], 12)):
        flow.examples(Quadrotor(), MassFactor(), box, 20, torch.Generator().manual_seed(0))
    assert len(seen) >= 2
    for state in seen:
        torch.testing.assert_close(state[..., 6:10].norm(dim=-1), torch.ones(state.shape[:-1]))
