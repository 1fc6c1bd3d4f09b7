"""The regression: closed forms of its pieces, and which faults it corrects."""

import math

import numpy as np
import pytest
import torch
from effects import before, flow_of

from afm_rl.correction import ActionFlow
from afm_rl.correction.belief import beliefs, likeliest_delay, prior
from afm_rl.correction.core import RegressionCore
from afm_rl.correction.records import Measurement, Plan, Settings
from afm_rl.correction.regression import evidence_of, fit
from afm_rl.correction.table import FREE, FREE_OFFSET, Hypothesis
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold


def dead_zone(u):
    """Nothing happens below a fifth of the largest action."""
    return u.sign() * (u.abs() - 0.2).clamp_min(0.0)


def plan_of(action):
    one = torch.ones_like(action)
    return Plan(action, -one, one, -one, one)


def memory_of(core, commands, effects, std=0.01):
    """Return a memory ``(1, ...)`` full of pairs ``(A, M)`` since the last change."""
    like = torch.zeros(1, 1, dtype=commands.dtype)
    return core.begin(like)._replace(
        commands=commands[None],
        effects=effects[None],
        stds=torch.full_like(commands[None], std),
        validity=torch.ones_like(commands[:1]),
    )


@pytest.mark.parametrize("actions", [1, 8])
def test_delays_are_late_together_and_their_prior_counts_once(actions):
    core = RegressionCore(actions).double()
    none = torch.zeros(actions, core.pairs, dtype=torch.float64)
    memory, rows = memory_of(core, none, none), core.table.hypotheses
    before = prior(core.table, core.settings, memory)[0].softmax(-1)[0, 0] @ core.table.has_delay
    odds = core.settings.nominal_log_odds + float((before[0] / before[3:5].sum()).log())
    losses = torch.tensor([0.0 if row.delay in (3, 4) else odds / actions for row in rows])
    losses = losses.expand(1, actions, -1).double()

    def delay_after(more):
        return likeliest_delay(core.table, core.settings, memory._replace(losses=losses * more))

    found = [float(delay_after(more)) for more in (0.98, 1.02)]
    assert found == [0.0, 3.0]


@pytest.mark.parametrize(
    ("name", "regressors", "mean", "precision"),
    [
        ("gain", lambda u: [u], [1.0], [FREE]),
        ("line", lambda u: [u, np.ones_like(u)], [1.0, 0.0], [FREE, FREE_OFFSET]),
    ],
)
def test_a_row_is_fitted_by_least_squares_with_its_prior(name, regressors, mean, precision):
    core = RegressionCore(1).double()
    draws = torch.Generator().manual_seed(0)
    u = 2 * torch.rand(1, core.pairs, generator=draws, dtype=torch.float64) - 1
    v = 0.7 * u + 0.1 + 0.01 * torch.randn(u.shape, generator=draws, dtype=torch.float64)
    memory = memory_of(core, u, v)
    plan = plan_of(torch.zeros(1, 1, dtype=u.dtype))
    found = fit(core.table, memory, evidence_of(core.table, memory, plan))
    curve = found.curves[0, 0, core.table.names.index(name)]
    # the prior is as many pairs as there are coefficients
    root = np.sqrt(precision)
    x = np.vstack([np.stack(regressors(u[0].numpy()), -1), np.diag(root)])
    wanted = np.linalg.lstsq(x, np.append(v[0].numpy(), root * mean), rcond=None)[0]
    gain_and_offset = curve[[0, -1]][: len(wanted)].numpy()
    np.testing.assert_allclose(gain_and_offset, wanted, atol=1e-8)


def test_beliefs_are_prior_times_likelihood_and_sum_to_one():
    core = RegressionCore(1).double()
    memory = core.begin(torch.zeros(1, 1, dtype=torch.float64))
    log_prior, _, _ = prior(core.table, core.settings, memory)
    losses = torch.linspace(0, 3, len(core.table.names), dtype=torch.float64).expand(1, 1, -1)
    found = beliefs(core.table, core.settings, memory._replace(losses=losses))
    wanted = (log_prior - losses).exp()
    torch.testing.assert_close(found, wanted / wanted.sum())
    assert found.sum().item() == pytest.approx(1.0)


def test_axes_share_half_of_their_prior():
    core = RegressionCore(3).double()
    memory = core.begin(torch.zeros(1, 1, dtype=torch.float64))
    reversed_motor = core.table.names.index("reversed")
    losses = torch.zeros(1, 3, len(core.table.names), dtype=torch.float64)
    alone = beliefs(core.table, core.settings, memory._replace(losses=losses))
    losses[:, 1:] = 20.0
    losses[:, 1:, reversed_motor] = 0.0
    found = beliefs(core.table, core.settings, memory._replace(losses=losses))
    torch.testing.assert_close(found.sum(-1), torch.ones(1, 3, dtype=torch.float64))
    # the two other axes are sure of it: each doubts another hypothesis by 7 nats, no more
    odds = alone[0, 0] * torch.full_like(alone[0, 0], math.exp(-14.0))
    odds[reversed_motor] = alone[0, 0, reversed_motor]
    wanted = 0.5 * alone[0, 0] + 0.5 * odds / odds.sum()
    torch.testing.assert_close(found[0, 0], wanted)


def observe(core, memory, u, v, std=1e-3):
    """Return the memory with another pair; every hypothesis expected the command."""
    memory = memory._replace(
        forecasts=u.expand(1, 1, len(core.table.names)), expected=u.expand(1, 1)
    )
    pair = torch.stack([u, v, torch.full_like(u, std)]).view(3, 1, 1, 1)
    innovation = ((v - u).abs() / std).view(1, 1)
    one, none = torch.ones(1, 1), torch.zeros(1, 0, 1)
    return core.observe(memory, Measurement(*pair, one, innovation, none, torch.zeros(1, 1, 1)))


@pytest.mark.parametrize("largest", [0.1, 0.5, 1.0])
def test_the_noise_is_at_least_a_fiftieth_of_the_largest_command(largest):
    core = RegressionCore(1)
    memory = core.begin(torch.zeros(1, 1))
    for _ in range(60):
        memory = observe(core, memory, torch.tensor(largest), torch.tensor(largest))
    assert memory.noise.item() == pytest.approx(max(largest, 0.25) / 50)


def test_the_noise_that_no_hypothesis_explains_is_learned():
    core, draws, found = RegressionCore(1), torch.Generator().manual_seed(0), []
    memory = core.begin(torch.zeros(1, 1))
    for _ in range(300):
        u = 2 * torch.rand((), generator=draws) - 1
        v = u + 0.2 * torch.randn((), generator=draws)
        memory = observe(core, memory, u, v)
        found.append(memory.noise.item())
    assert np.mean(found[50:]) == pytest.approx(0.2, rel=0.2)


def test_no_hypothesis_falls_far_behind():
    core, draws = RegressionCore(2), torch.Generator().manual_seed(0)
    memory = core.begin(torch.zeros(1, 1))
    late_ones = [name.startswith("late") for name in core.table.names]
    for _ in range(50):
        u, v = 2 * torch.rand(2, 1, 2, 1, generator=draws) - 1
        std, one = torch.full_like(u, 0.01), torch.ones(1, 1)
        none, hidden = torch.zeros(1, 0, 1), torch.zeros(1, 2, 2)
        measured = Measurement(u, v, std, one, 100 * one, none, hidden)
        memory, _ = core.tick(memory, measured, plan_of(v[..., 0]))
        behind = memory.losses - memory.losses.amin(-1, True)
        assert 0 <= behind.min() and behind.max() <= 16 + 1e-5
    healthy = core.begin(torch.zeros(1, 1))
    healthy = healthy._replace(forecasts=torch.eye(len(core.table.names))[0].expand(1, 2, -1))
    measured = Measurement(*torch.ones(3, 1, 2, 1), one, 0 * one, none, hidden)
    for _ in range(50):
        healthy = core.observe(healthy, measured)
    behind = (healthy.losses - healthy.losses.amin(-1, True))[..., late_ones]
    assert behind.max() == pytest.approx(8.0, abs=1e-5)


@pytest.mark.parametrize("size", [1, 2, 6, 12])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_healthy_robot_is_left_alone_to_the_bit(line, drive, plans, size, noise):
    planned = plans(40, 2, size, size=1.0)
    model = line(size, noise_std=max(noise, 1e-3))
    found, _ = drive(flow_of(size), model, lambda sent: sent[-1], planned, noise=noise)
    assert torch.equal(found.executed_action, planned) and torch.equal(
        found.predicted_effect, planned
    )
    assert not found.corrected.any()


@pytest.mark.parametrize("delay", [0, 2])
def test_a_lag_is_compensated_behind_a_known_delay_too(line, drive, delay):
    time = torch.arange(60.0).unsqueeze(-1)
    planned = 0.4 * torch.sin(0.2 * time + torch.tensor([0.0, 1.0]))

    def lag(sent):
        return sum(0.5 * 0.5**k * before(sent, k + delay) for k in range(12))

    _, effects = drive(flow_of(2, delay=delay), line(2), lag, planned)
    miss, plain = (effects[delay:] - planned[: 60 - delay]).abs(), 0.4 * 0.2  # one step behind
    assert miss[30:].mean() < 0.1 * plain


def test_redundant_actuators_share_what_one_no_longer_does(drive, plans):
    """Three thrusters push one mass, which shows their sum alone."""
    model = KnownDynamics(
        lambda state, action: state + action.sum(-1, keepdim=True), Manifold(1), 3, 1e-3
    )
    weak = torch.tensor([0.0, 1.0, 1.0])
    planned = plans(40, 4, 3, size=0.4)
    _, effects = drive(
        flow_of(3), model, lambda sent: weak * sent[-1], planned, state=torch.zeros(4, 1)
    )
    miss, plain = (effects - planned).sum(-1).abs(), (planned * (weak - 1)).sum(-1).abs()
    assert miss[20:].mean() < 0.4 * plain[20:].mean()


def test_single_precision_does_what_double_precision_does(line, drive, plans):
    planned = plans(20, 3, 2)
    single, _ = drive(flow_of(2), line(2), lambda sent: 0.2 - sent[-1], planned)
    double = flow_of(2).double(), line(2).double()
    double, _ = drive(*double, lambda sent: 0.2 - sent[-1], planned.double())
    torch.testing.assert_close(single[0], double[0].float(), rtol=0, atol=2e-3)


def test_a_hypothesis_of_your_own_is_believed_and_used(line, drive, plans):
    row = Hypothesis("dead zone", (dead_zone,), (1.0,), cause="a dead zone")
    planned, miss = plans(40, 4, 1, size=0.7), {}
    for own in ((), (row,)):
        flow = flow_of(1, hypotheses=own)
        _, effects = drive(flow, line(1), lambda sent: dead_zone(sent[-1]), planned)
        miss[own] = (effects - planned)[15:].abs().mean().item()
    belief = flow.belief_in(drive.memory)[..., flow.causes.index("a dead zone"), 0]
    assert belief.mean() > 0.9
    assert miss[row,] < 0.3 * miss[()]


def test_a_fault_that_depends_on_where_the_robot_is(drive, plans):
    """On one half of the ground, where it is at every second step, actions have half an effect."""

    def move(state, action):
        return torch.cat([state[..., :2] + action, 1.0 - state[..., 2:]], -1)

    def effect(sent):
        return sent[-1] * (1.0 if len(sent) % 2 else 0.5)

    planned, model, miss = plans(60, 4, 2, size=0.4), KnownDynamics(move, Manifold(3), 2, 1e-3), []
    for coordinates in ([], [2]):
        flow = flow_of(2, context_coordinates=coordinates)
        _, effects = drive(flow, model, effect, planned, state=torch.zeros(4, 3))
        miss.append((effects - planned)[30:].abs().mean())
    assert miss[1] < 0.5 * miss[0]


@pytest.mark.parametrize(("memory", "max_delay"), [(11, 8), (20, 25)])
def test_a_memory_shorter_than_the_delays_is_refused(memory, max_delay):
    with pytest.raises(ConfigurationError, match=f"memory={memory}: expected at least"):
        flow_of(1, memory=memory, max_delay=max_delay)


def test_settings_have_the_defaults_of_the_corrector():
    assert flow_of(1).core.settings == Settings()


def test_without_a_reading_a_robot_is_where_it_was_last():
    """No hypothesis that depends on the place may expect what is not a number."""
    high = torch.tensor([1.0, 1.5])
    flow, model = ActionFlow(-high, high, context_coordinates=[0, 1]), Dubins()
    bounds, state = torch.stack([-high, high]), torch.zeros(3)
    memory, plan = flow.begin(state), torch.tensor([0.5, 0.2])
    for step in range(40):
        memory, correction = flow.correct(memory, plan, model, bounds)
        state = model(state, -correction.executed_action)
        seen = torch.full((3,), torch.nan) if step >= 10 and step % 3 == 0 else state
        memory = flow.observe(memory, seen)
        for name, field in correction._asdict().items():
            assert field is None or field.isfinite().all(), name
        for name in set(memory) - {"state", "states", "next_states"}:
            assert memory[name].isfinite().all(), name
    assert correction.corrected
