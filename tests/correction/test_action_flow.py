"""The action flow, whatever its weights."""

import math
import os

import pytest
import torch
from harness import half_reversed, same_weights

from afm_rl.correction import ActionFlow, LeastSquares, PaperFlow
from afm_rl.correction.achievable import MODES
from afm_rl.correction.belief import Belief, mean_and_std
from afm_rl.correction.core import points_of, probes_of
from afm_rl.correction.hypotheses import FILTER
from afm_rl.correction.network import AxisNetwork
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.storage.artefacts import load_artefact, save_artefact

SIZES = [1, 2, 6, 17]


def flow_of(size, **settings):
    network = AxisNetwork(width=16, latent=8)
    return ActionFlow(-torch.ones(size), torch.ones(size), network=network, **settings)


def upset(sent):
    """Half of the axes are reversed, all are biased."""
    return half_reversed(sent) + 0.1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("batch", [(), (3,)], ids=str)
def test_an_aligned_robot_is_left_alone_to_the_bit(line, drive, plans, size, batch):
    planned = plans(8, *batch, size, size=1.0)
    found, _ = drive(flow_of(size), line(size), lambda sent: sent[-1], planned, noise=1e-3)
    executed, predicted, spread, _, innovation, misaligned, _ = found
    assert torch.equal(executed, planned) and torch.equal(predicted, planned)
    assert not misaligned.any() and not spread.any() and (innovation < 5).all()


@pytest.mark.parametrize(
    ("reached", "corrected", "pair"),
    [
        (0.3005, 0.0, (0.3, 0.3, 1.0)),  # half a standard deviation needs no explanation
        (0.3005, 1.0, (0.3, 0.3005, 1.0)),  # but where actions are corrected all is looked at
        (50.0, 0.0, (0.3, 4.0, 1.0)),  # as far as effects carry news
        (math.nan, 0.0, (0.3, 0.0, 0.0)),  # what was sent is known
    ],
)
def test_a_transition_becomes_a_pair(line, reached, corrected, pair):
    flow, model = flow_of(1), line(1, noise_std=1e-3)
    sent = torch.tensor([0.3])
    memory = flow.executing(flow.begin(torch.zeros(1)), sent, sent)
    memory = flow.observe(memory, torch.tensor([reached]))
    fields = flow.unpack(memory, 1) | {"corrects": torch.tensor([corrected])}
    newest = flow.remember(fields, flow.measure(fields, model))["pairs"][-1]
    torch.testing.assert_close(newest[[0, 1, 3]], torch.tensor(pair), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (0.5, [5.0, 0.1, 9.0], [5.0, 4.0, 9.0]),  # one that foresaw a surprise leads by the odds
        (2.0, [5.0, 0.1, 9.0], [5.0, 0.1, 9.0]),  # it was one before
        (0.5, [0.9, 40.0, 40.0], [0.9, 16.9, 8.9]),  # none falls far behind, a delay least
    ],
)
def test_until_a_change_is_known_models_are_held_together(before, after, expected):
    flow = flow_of(1, odds=1.0)
    rows = [flow.models.index(name) for name in ("nothing has changed", "recent", "delay_1")]
    losses = torch.full((2, len(flow.models), 1), 9.0)
    losses[0, rows[0]], losses[1, rows, 0] = before, torch.tensor(after)
    found = flow.share_losses(*losses)[rows, 0]
    torch.testing.assert_close(found, torch.tensor(expected))


def test_a_model_falls_behind_only_while_an_axis_is_in_doubt():
    flow = flow_of(2)
    losses = torch.full((len(flow.models), 2), 40.0)
    losses[:2] = torch.tensor([[0.5, 5.0], [40.0, 0.1]])
    assert torch.equal(flow.share_losses(losses, losses), losses)


@pytest.mark.parametrize(("largest", "floor"), [(0.1, 0.005), (0.5, 0.01), (3.0, 0.02)])
def test_the_least_noise_is_a_share_of_the_largest_command(largest, floor):
    flow = flow_of(1)
    parts = flow.unpack(flow.begin(torch.zeros(1)), 1)
    parts["pairs"][3, 0] = -largest
    torch.testing.assert_close(flow.floor(parts), torch.tensor([floor]))


def test_while_nothing_has_changed_only_a_delay_that_is_believed_keeps_its_losses():
    flow = flow_of(1)
    parts = flow.unpack(flow.begin(torch.zeros(1)), 1)
    parts["losses"] = torch.linspace(0.5, 2.0, len(flow.models)).flip(0).unsqueeze(-1)
    parts["losses"][0] = 1.0
    for late, keeps in ((0, flow.delays < -1), (2, (flow.delays == 2) | (flow.delays < 0))):
        parts["delay"] = torch.tensor([float(late)])
        losses = flow.as_planned(parts, torch.zeros(1))["losses"]
        kept = torch.where(keeps.unsqueeze(-1), parts["losses"], parts["losses"].clamp_max(1.0))
        assert torch.equal(losses, kept)


@pytest.mark.parametrize("delay", [0, 2])
def test_what_actuators_gave_of_what_acts_now_is_foreseen(delay):
    low, high = torch.tensor([-2.0, -1.0]), torch.tensor([2.0, 4.0])
    flow = ActionFlow(low, high, network=AxisNetwork(width=16, latent=8), delay=delay)
    memory, sent = flow.begin(torch.zeros(3)), torch.tensor([1.0, 2.0])
    for _ in range(delay + 1):
        memory = flow.observe(flow.executing(memory, sent, sent), torch.randn(3))
    memory = flow.executing(memory, sent, sent)
    told = flow.reported(memory, torch.tensor([0.5, 4.0]))
    before, after = (flow.unpack(m, 3) for m in (memory, told))
    moved = after["forecasts"] - before["forecasts"]
    torch.testing.assert_close(moved, torch.tensor([-0.25, 0.5]).expand_as(moved))


def test_models_that_take_a_new_delay_begin_as_good_as_the_best_that_had_it():
    flow = flow_of(1)
    losses = torch.arange(float(len(flow.models))).unsqueeze(-1)
    weights = torch.full_like(losses, 1e-6)
    weights[flow.models.index("delay_3")] = 1.0
    belief, prior = Belief(losses, losses, torch.ones(1)), losses + weights.log()
    best = losses[flow.delays == 3].min()
    told = flow.delayed(belief, prior, torch.tensor(0), torch.ones(1, dtype=torch.bool))
    assert told["delay"] == 3 and (told["losses"][flow.delays < 0] == best).all()
    assert torch.equal(told["losses"][flow.delays >= 0], losses[flow.delays >= 0])
    told = flow.delayed(belief, prior, torch.tensor(3), torch.ones(1, dtype=torch.bool))
    assert told["delay"] == 3 and torch.equal(told["losses"], losses)


@pytest.mark.parametrize(("healthy", "late"), [(0.2, 3), (0.3, 0)])
def test_a_delay_is_believed_once_a_healthy_robot_is_less_than_a_quarter_as_probable(healthy, late):
    flow = flow_of(1)
    losses = torch.full((len(flow.models), 1), 50.0)
    losses[0], losses[flow.models.index("delay_3")] = -math.log(healthy), -math.log(1 - healthy)
    belief, prior = Belief(losses, losses, torch.ones(1)), torch.zeros_like(losses)
    told = flow.delayed(belief, prior, torch.tensor(0), torch.ones(1, dtype=torch.bool))
    assert told["delay"] == late


@pytest.mark.parametrize(
    ("before", "newest", "sudden"), [(4.0, 6.0, True), (4.0, 4.0, False), (6.0, 6.0, False)]
)
def test_a_change_is_sudden_if_only_the_newest_effect_misses(before, newest, sudden):
    """By more than five deviations."""
    flow = flow_of(1)
    parts = flow.unpack(flow.begin(torch.zeros(1)), 1)
    deviation = parts["noise"].item()
    parts["pairs"][-2:, 1] = deviation * torch.tensor([before, newest])  # of commands of zero
    assert flow.is_sudden(parts) == sudden


def test_an_effect_is_as_uncertain_as_the_models_differ_and_as_nothing_explains(line):
    flow, command = flow_of(1), torch.tensor([0.4])
    memory = flow.begin(torch.zeros(1))
    differ, noise = (flow.predict(memory, x * command, line(1))[1] for x in (1, 0))
    torch.testing.assert_close(noise, flow.noise_in(memory), rtol=0.01, atol=0)  # at rest all agree
    effects = flow.unpack(flow.executing(memory, command, command), 1)["forecasts"]
    apart = mean_and_std(effects, flow.weights_in(memory))[1]
    torch.testing.assert_close(differ, torch.hypot(apart, noise))


def test_a_memory_is_as_long_as_hypotheses_look_back_from_the_oldest_row():
    longest = 12 + FILTER - 1
    assert flow_of(1, rows=12, memory=longest).memory == longest
    with pytest.raises(ConfigurationError, match=f"expected at least {longest} for 12 rows"):
        flow_of(1, rows=12, memory=longest - 1)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", MODES)
def test_corrections_are_finite_and_in_the_box(line, drive, plans, size, mode):
    flow = flow_of(size, saturation=mode, odds=0.0)
    found, _ = drive(flow, line(size), upset, plans(6, 4, size, size=1.0))
    executed, _, _, bounds, _, misaligned, _ = found
    assert all(part.isfinite().all() for part in found) and misaligned[2:].any()
    assert (executed.abs() <= 1 + 1e-6).all()
    assert (bounds[:, :, 0] < bounds[:, :, 1]).all()


@pytest.mark.parametrize("kind", [ActionFlow, LeastSquares])
def test_rows_from_before_a_change_stay_old_when_a_learning_model_is_asked_again(line, kind):
    box = torch.tensor([[-1.0], [1.0]])
    corrector, model = kind(*box), line(1)
    model.taught_in = os.getpid()
    memory, state = corrector.begin(torch.zeros(1)), torch.zeros(1)
    for step in range(10):
        memory, found = corrector.correct(memory, torch.full((1,), 0.5), model, box)
        state = model(state, found.executed if step < 6 else -found.executed)
        memory = corrector.observe(memory, state)
    memory, _ = corrector.correct(memory, torch.full((1,), 0.5), model, box)
    valid = corrector.unpack(memory, 1)["pairs"][-10:, 3]
    assert valid.tolist() == 6 * [0.5] + 4 * [1.0]


@pytest.mark.parametrize("corrector", [ActionFlow, LeastSquares])
def test_bounds_in_double_precision_are_answered_in_it(line, drive, plans, corrector):
    ends = torch.ones(2, dtype=torch.float64)
    found, _ = drive(corrector(-ends, ends), line(2), upset, plans(8, 2, size=1.0).double())
    assert found[5][-1].all() and found[0].dtype == torch.float64


@pytest.mark.parametrize("size", [1, 2, 6])
@pytest.mark.parametrize("place", [[], [0]], ids=["", "by place"])
def test_a_batch_equals_single_missions(line, drive, plans, size, place):
    """From one point: among samples that are as good, rounding would decide."""
    flow = flow_of(size, place=place, source_std=0.0)
    planned = plans(6, 4, size)
    factor = torch.tensor([1.0, -1.0, 0.5, 0.0]).view(4, 1)  # one is align, one is dead
    together, _ = drive(flow, line(size), lambda sent: factor * sent[-1], planned)
    assert not together[5][:, 0].any() and together[5][4:, 1].all()
    for k in range(4):
        alone, _ = drive(flow, line(size), lambda s, k=k: factor[k] * s[-1], planned[:, k])
        for one, many in zip(alone, together, strict=True):
            torch.testing.assert_close(one, many[:, k], rtol=1e-3, atol=1e-3)


def test_source_points_cancel_and_are_always_the_same():
    points = points_of(6, 3)
    assert points.shape == (6, 3) and torch.equal(points, points_of(6, 3))
    torch.testing.assert_close(points.sum(0), torch.zeros(3))
    assert points_of(1, 2).shape == (1, 2)


@pytest.mark.parametrize("size", SIZES)
def test_probes_hold_the_ends_of_all_axes(size):
    probes = probes_of(size)
    assert probes.abs().max() <= 1 and len(probes) >= 2 * size + 1
    ends = torch.cat([torch.eye(size), -torch.eye(size)])
    assert (probes.unsqueeze(0) == ends.unsqueeze(1)).all(-1).any(-1).all()


def test_only_weights_are_stored_and_load_where_they_fit(tmp_path):
    path, flow, other = tmp_path / "flow.safetensors", flow_of(2), flow_of(17)
    assert set(flow.state_dict()) == {name for name, _ in flow.named_parameters()}
    for parameter in other.parameters():
        parameter.data.zero_()
    save_artefact(path, flow, flow.signature)
    load_artefact(path, other, other.signature)  # any number of actions
    assert same_weights(flow, other)
    paper = PaperFlow([-1.0], [1.0], [0], 1)
    with pytest.raises(ArtefactError, match="kind"):
        load_artefact(path, paper, paper.signature)
