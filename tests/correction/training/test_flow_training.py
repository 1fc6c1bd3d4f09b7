"""The loss of flow matching, training, and the weights of the package."""

import hashlib
import math
from importlib.resources import files

import pytest
import torch
from safetensors.torch import load

import afm_rl.correction.network
from afm_rl.correction.experts import fit_experts
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.correction.training import draw_examples
from afm_rl.correction.training.loss import PRECISION, flow_losses
from afm_rl.correction.training.pretrain import pretrain
from afm_rl.errors import ArtefactError


def network(seed=0):
    return AxisNetwork(width=16, latent=8, seed=seed)


@pytest.fixture
def drawn():
    return draw_examples(32, 2, 6, 4, "mixed", torch.Generator().manual_seed(0))


class Exact(AxisNetwork):
    """Knows the right answers, effects but for some."""

    def __init__(self, drawn, off):
        super().__init__(width=16, latent=8)
        self.drawn, self.off = drawn, off

    def velocity(self, asked, tau, point):
        return (self.drawn.intended - point) / (1 - tau)

    def effect(self, encoded, executed):
        return self.drawn.effect + self.off


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_the_exact_velocity_costs_nothing_and_a_wrong_effect_its_size(drawn, off):
    generator = torch.Generator().manual_seed(0)
    velocity, effect = flow_losses(Exact(drawn, off), drawn, "mixed", generator)
    assert velocity.shape == effect.shape == (32,)
    torch.testing.assert_close(velocity, torch.zeros(32), rtol=0, atol=1e-4)
    size = math.hypot(off, PRECISION) - PRECISION  # quadratic near zero, then linear
    torch.testing.assert_close(effect, torch.full((32,), size), rtol=1e-3, atol=1e-6)


def test_pretraining_helps_and_follows_the_seed():
    def error(trained):
        fresh = draw_examples(200, 2, 12, 4, "mixed", torch.Generator().manual_seed(7))
        with torch.no_grad():
            parts = flow_losses(trained, fresh, "mixed", torch.Generator().manual_seed(7))
        return float((parts[0] + parts[1]).mean())

    trained = []
    for _ in range(2):
        fresh = network()
        pretrain(fresh, 30, batch_size=24, seed=1)
        trained.append(fresh)
    assert error(trained[0]) < 0.9 * error(network())
    for one, other in zip(*(net.parameters() for net in trained), strict=True):
        assert torch.equal(one, other)


def test_the_weights_of_the_package_are_small_sound_and_frozen():
    data = files("afm_rl.correction").joinpath("universal.safetensors").read_bytes()
    assert len(data) < 2 * 2**20
    net = load_universal()
    stored = load(data)
    assert all(torch.equal(value, stored[name]) for name, value in net.state_dict().items())
    assert not any(parameter.requires_grad for parameter in net.parameters())
    assert all(value.isfinite().all() for value in stored.values())


@pytest.mark.parametrize("place", [100, -5])
def test_a_flipped_bit_in_the_weights_is_refused(place, tmp_path, monkeypatch):
    folder = files("afm_rl.correction")
    data = bytearray(folder.joinpath("universal.safetensors").read_bytes())
    data[place] ^= 1
    (tmp_path / "universal.safetensors").write_bytes(data)
    said = folder.joinpath("universal.safetensors.sha256").read_text()
    (tmp_path / "universal.safetensors.sha256").write_text(said)
    assert hashlib.sha256(data).hexdigest() not in said
    monkeypatch.setattr(afm_rl.correction.network, "files", lambda package: tmp_path)
    with pytest.raises(ArtefactError, match="universal.safetensors: damaged"):
        load_universal()


def test_experts_fitted_while_driving_can_be_used_in_training(drawn):
    """Constants that were made in inference mode must not spoil gradients later."""
    with torch.inference_mode():
        fit_experts(draw_examples(2, 5, 7, 1, "clip", torch.Generator().manual_seed(0)).rows)
    later = draw_examples(2, 5, 7, 4, "clip", torch.Generator().manual_seed(0))
    net = network()
    flow_losses(net, later, "clip", torch.Generator())[0].mean().backward()
