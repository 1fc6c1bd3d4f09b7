"""Conditional flow matching: loss and training."""

import io
import math
import sys

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import CFMLoss, ContextFlow, Correction, Examples, train_flow
from afm_rl.flow.cfm import BLOCK, POOL, PRECISE, WEIGHT, held_out_error
from afm_rl.flow.saturation import LIMIT

TINY = {"window": 3, "hidden": [8], "latent": 4}


class Bare(ContextFlow):
    """Makes nothing of a context, and knows one direction only."""

    has_effect = False

    def read(self, features):
        return features

    def forward(self, features, planned, tau, point):
        return torch.zeros_like(point)


class Exact(Bare):
    """Knows the right answers: they are in the context, in half ranges."""

    has_effect = True

    def forward(self, features, planned, tau, point):
        return (features[..., :2] - point) / (1 - tau)

    def effect(self, features, executed):
        return features[..., 2:] + self.off


@pytest.fixture
def examples(box):
    low, high = box
    drawn = [low + (high - low) * torch.rand(64, 2) for _ in range(4)]
    return dict(zip(("planned", "intended", "probe", "worth"), drawn, strict=True))


@pytest.fixture
def train(states, gains, box):
    def run(seed=0, **settings):
        flow = ContextFlow(*box, **TINY)
        settings = {"iterations": 6, "batch_size": 16, "seed": seed, **settings}
        return flow, train_flow(flow, Dubins(), gains, states, **settings)

    return run


def same(left, right):
    right = right.state_dict()
    return all(torch.equal(value, right[name]) for name, value in left.state_dict().items())


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_the_exact_velocity_costs_nothing_and_a_wrong_effect_its_size(box, examples, off):
    flow = Exact(*box, **TINY)
    flow.off = off
    features = torch.cat([flow.normalise(examples[name]) for name in ("intended", "worth")], -1)
    loss = CFMLoss(flow)(TensorDict({**examples, "features": features}, [64]))["loss_cfm"]
    size = math.hypot(off, PRECISE) - PRECISE  # quadratic near zero, then linear
    assert float(loss) == pytest.approx(WEIGHT * size, abs=1e-6)


def test_effects_beyond_the_limit_are_cut(box, examples):
    flow = Exact(*box, **TINY)
    flow.off = 0.0
    far = {**examples, "worth": 100 * torch.ones(64, 2)}
    features = torch.cat([flow.normalise(examples["intended"]), torch.full((64, 2), LIMIT)], -1)
    loss = CFMLoss(flow)(TensorDict({**far, "features": features}, [64]))["loss_cfm"]
    assert float(loss) == pytest.approx(0, abs=1e-6)


def test_what_is_read_depends_on_what_the_flow_knows(box, examples):
    loss = CFMLoss(ContextFlow(*box, **TINY))
    assert loss.in_keys == ["features", "planned", "intended", "probe", "worth"]
    plain = CFMLoss(Bare(*box, **TINY))
    assert plain.in_keys == ["features", "planned", "intended"]
    features = torch.zeros(64, plain.flow.feature_size)
    few = {name: examples[name] for name in ("planned", "intended")}
    by_name = plain(features=features, **few)
    assert by_name.shape == () and by_name > 0
    loss.set_keys(probe=("probe", "action"), worth="effect")
    assert loss.in_keys[3:] == [("probe", "action"), "effect"]


def test_a_still_flow_pays_for_the_way(box, examples):
    flow = Bare(*box, source_std=0.0, **TINY)
    td = TensorDict({**examples, "features": torch.zeros(64, flow.feature_size)}, [64])
    way = flow.normalise(examples["intended"]) - flow.normalise(examples["planned"])
    each = CFMLoss(flow, reduction="none")(td)["loss_cfm"]
    torch.testing.assert_close(each, way.square().mean(-1))
    torch.testing.assert_close(CFMLoss(flow, reduction="sum")(td)["loss_cfm"], each.sum())
    torch.testing.assert_close(CFMLoss(flow)(td)["loss_cfm"], each.mean())


def test_times_and_sources_are_drawn_as_they_should(box, examples):
    drawn = {}

    class Spy(Bare):
        def forward(self, features, planned, tau, point):
            drawn.update(tau=tau, point=point)
            return torch.zeros_like(point)

    flow, many = Spy(*box, source_std=0.3, **TINY), 4000
    planned = examples["planned"][:1].expand(many, -1)
    td = TensorDict({"planned": planned, "intended": planned}, [many])
    td["features"] = torch.zeros(many, flow.feature_size)
    CFMLoss(flow)(td)
    assert drawn["tau"].min() >= 0 and drawn["tau"].max() <= 1
    assert float(drawn["tau"].mean()) == pytest.approx(0.5, abs=0.02)
    noise = (drawn["point"] - flow.normalise(planned)) / (1 - drawn["tau"])
    assert float(noise.std()) == pytest.approx(0.3, rel=0.05)


def test_keys_can_be_chosen_and_entries_come_by_name(box, examples):
    flow = ContextFlow(*box, **TINY)
    features = torch.randn(64, flow.feature_size)
    expected = CFMLoss(flow)(TensorDict({**examples, "features": features}, [64]))["loss_cfm"]
    torch.testing.assert_close(CFMLoss(flow)(features=features, **examples), expected)
    loss = CFMLoss(flow)
    loss.set_keys(planned=("plan", "action"), features="context")
    assert loss.in_keys == ["context", ("plan", "action"), "intended", "probe", "worth"]
    rest = {name: value for name, value in examples.items() if name != "planned"}
    td = TensorDict({"context": features, **rest}, [64])
    td["plan", "action"] = examples["planned"]
    torch.testing.assert_close(loss(td)["loss_cfm"], expected)
    loss.in_keys = ["context"]
    assert loss.in_keys == ["context"]
    loss._forward_value_estimator_keys()  # torchrl calls this when keys change


def test_the_flow_is_shared_and_learns_through_the_loss(box, examples):
    flow = ContextFlow(*box, **TINY)
    loss = CFMLoss(flow)
    assert loss.flow is flow and not loss.functional
    td = TensorDict({**examples, "features": torch.randn(64, flow.feature_size)}, [64])
    loss(td)["loss_cfm"].backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in flow.parameters())
    with pytest.raises(ConfigurationError, match="loss.reduction"):
        CFMLoss(flow, reduction="median")


def test_training_helps(trained_flow, trained_flow_error, states, gains):
    untrained = ContextFlow(trained_flow.centre - 1, trained_flow.centre + 1, window=4)
    fresh = trained_flow.examples(Dubins(), gains, states, 2000, torch.Generator().manual_seed(9))
    assert held_out_error(trained_flow, fresh) < 0.5 * held_out_error(untrained, fresh)
    assert trained_flow_error < 0.4


def test_the_held_out_error_is_in_half_ranges(box, examples):
    class Idle(ContextFlow):
        def correct(self, context, state, planned):
            return Correction(planned, torch.zeros_like(planned))

    flow = Idle(*box, **TINY)
    features = torch.zeros(64, flow.feature_size)
    given = Examples(features, **examples)
    gap = (examples["planned"] - examples["intended"]) / flow.half_range
    assert held_out_error(flow, given) == pytest.approx(float(gap.square().mean().sqrt()))


@pytest.mark.parametrize("reuse", [1, 3])
def test_the_seed_decides_everything_and_the_global_generator_nothing(train, reuse):
    before = torch.get_rng_state()
    first, error = train(reuse=reuse)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(5)
    again, same_error = train(reuse=reuse)
    other, _ = train(seed=1, reuse=reuse)
    assert same(first, again) and error == same_error and not same(first, other)


def test_examples_are_used_again_when_the_model_is_slow(box, states, gains, make_ensemble):
    class Counting(ContextFlow):
        def examples(self, model, regime, state_box, count, generator, plans=1):
            counts.append(count)
            return super().examples(model, regime, state_box, count, generator, plans)

    def made(reuse, model=None):
        counts.clear()
        settings = {"iterations": 20, "batch_size": 8, "reuse": reuse}
        train_flow(Counting(*box, **TINY), model or Dubins(), gains, states, **settings)
        return sum(counts[:-1])  # the last are held out

    counts = []
    assert made(1) == 3 * BLOCK * 8  # the last block is not used up
    assert made(4) == (POOL + 4) * 8  # a new batch after every four, but for the last
    assert made(64) == POOL * 8
    assert made(None) == made(1)
    assert made(None, make_ensemble()) < made(8)


def test_the_model_is_not_changed_and_gradients_may_be_off(trained_ensemble, box, states, gains):
    before = {name: value.clone() for name, value in trained_ensemble.state_dict().items()}
    flow = ContextFlow(*box, **TINY)
    start = {name: value.clone() for name, value in flow.state_dict().items()}
    with torch.no_grad():
        train_flow(flow, trained_ensemble, gains, states, iterations=2, batch_size=8)
    after = trained_ensemble.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert not all(torch.equal(value, start[name]) for name, value in flow.state_dict().items())


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_can_be_shown_on_a_terminal(train, monkeypatch):
    written = {}
    for progress in (False, True):
        monkeypatch.setattr("sys.stderr", Terminal())
        flow, _ = train(progress=progress)
        written[progress] = sys.stderr.getvalue()
    assert written[False] == "" and "training the flow" in written[True]
    assert same(flow, train()[0])


@pytest.mark.parametrize(
    "settings",
    [{"iterations": 0}, {"batch_size": 1}, {"reuse": 0}, {"lr": 0.0}, {"seed": 1.5}],
    ids=str,
)
def test_impossible_settings_are_refused(train, settings):
    with pytest.raises(ConfigurationError, match=f"corrector.train.{next(iter(settings))}"):
        train(**settings)


@pytest.mark.parametrize("flow", [None, torch.nn.Linear(2, 2)], ids=str)
def test_a_loss_is_of_a_flow(flow):
    with pytest.raises(ConfigurationError, match="loss.flow: expected a Flow, got"):
        CFMLoss(flow)


def test_a_loss_draws_from_a_whole_seed(box):
    with pytest.raises(ConfigurationError, match="loss.seed=1.5"):
        CFMLoss(ContextFlow(*box, **TINY), seed=1.5)


def test_plans_share_a_context(box, states, gains):
    flow, generator = ContextFlow(*box, **TINY), torch.Generator().manual_seed(0)
    found = flow.examples(Dubins(), gains, states, 10, generator, plans=4)
    assert [len(part) for part in found] == [10] * 5
    assert torch.equal(found.features[0], found.features[3])
    assert not torch.equal(found.features[3], found.features[4])
    assert not torch.equal(found.planned[0], found.planned[1])
    assert not torch.equal(found.probe[0], found.probe[1])
