"""The steps of a tick, each against a closed form."""

import math

import pytest
import torch

from afm_rl.correction import ActionFlow, Hypothesis, hypotheses
from afm_rl.correction.core import Forecast, Models, Plan
from afm_rl.correction.linear import Line
from afm_rl.correction.network import AxisNetwork
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold


def flow_of(size=1, **settings):
    network = AxisNetwork(width=16, latent=8)
    return ActionFlow(-torch.ones(size), torch.ones(size), network=network, **settings)


def fields_of(flow, states=1):
    return flow.unpack(flow.begin(torch.zeros(1, states)), states)


def models_of(flow, matrix):
    """Return what is believed where a map that mixes axes is certain."""
    certain = torch.zeros(1, len(flow.models), flow.action_size)
    certain[:, flow.models.index("affine")] = 1.0
    models = flow.likeliest(flow.fit(fields_of(flow)), certain)
    fits = dict(zip(flow.groups, models.fits, strict=True))
    of_maps = fits["map"]._replace(
        matrix=torch.tensor(matrix).expand_as(fits["map"].matrix),
        covariance=torch.zeros_like(fits["map"].covariance),
    )
    return models._replace(fits=list((fits | {"map": of_maps}).values()))


def sure(effects):
    """Return the forecast of certain models."""
    return Forecast(effects, torch.zeros_like(effects))


@pytest.mark.parametrize(("miss", "action"), [(0.1, 0.5), (0.2, 0.3)])
def test_an_action_must_promise_more_than_the_plan(miss, action):
    """The loss that it saves is log(1 + miss^2): of 0.01 too little, of 0.04 enough."""
    models = Models([], torch.ones(1, 1, 1))
    proposals, expected = torch.tensor([[[0.5], [0.3]]]), torch.tensor([[[[miss], [0.0]]]])
    nothing = torch.zeros(1, 1)
    found, effect = flow_of().choose(models, proposals, sure(expected), nothing, 1 + nothing)
    assert found == action and effect == expected[0, 0, [0.5, 0.3].index(action)]


def test_axes_choose_apart_only_if_that_is_no_worse_together():
    flow = flow_of(2)
    proposals = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.2, 0.2]]])
    noise = torch.full((1, 2), 0.1)
    # One effect is the sum, the other the difference: what suits one axis spoils the other.
    coupled = models_of(flow, [[1.0, 1.0], [1.0, -1.0]])
    expected = flow.expect(coupled, proposals)
    found, _ = flow.choose(coupled, proposals, expected, torch.tensor([[1.0, 0.0]]), noise)
    assert torch.equal(found, proposals[:, 2])
    apart = models_of(flow, [[1.0, 0.0], [0.0, 1.0]])
    expected = flow.expect(apart, proposals)
    wanted = torch.tensor([[1.0, 0.2]])
    found, effect = flow.choose(apart, proposals, expected, wanted, noise)
    assert torch.equal(found, wanted)
    torch.testing.assert_close(
        (apart.weights.unsqueeze(2) * effect.unsqueeze(2)).sum(1)[:, 0], wanted
    )


def test_bounds_are_optimistic_where_models_differ():
    foreseen = torch.tensor([[[[1.0], [0.5]], [[-1.0], [0.5]]]])  # of two models, for two actions
    reach = flow_of().reach(Models([], torch.full((1, 2, 1), 0.5)), foreseen)
    assert reach.flatten().tolist() == [-1.0, 1.0]


@pytest.mark.parametrize(
    ("effects", "variances", "weight", "action"),
    [
        ([[0.5, -0.5], [0.5, -0.5]], [0.0, 0.0], 0.5, -1.0),
        ([[0.5, -0.5], [0.5, 0.6]], [0.0, 0.0], 0.49, 1.0),  # more than half says that it is worse
        ([[0.5, -0.5], [0.5, 0.6]], [0.0, 0.0], 0.51, -1.0),
        ([[0.5, -0.5], [0.5, -1.4]], [0.0, 0.0], 0.5, -1.0),  # both: it is better
        ([[0.5, -0.5], [0.5, -1.6]], [0.0, 0.0], 0.5, 1.0),
        ([[0.5, -0.5], [0.5, -0.5]], [24.9, 24.9], 0.5, -1.0),  # .1 * 25 ** .5 = .5
        ([[0.5, -0.5], [0.5, -0.5]], [25.1, 25.1], 0.5, 1.0),
        ([[0.5, -0.5], [0.5, 3.0]], [0.0, 25.1], 0.5, -1.0),  # what knows nothing says nothing
        ([[0.5, 0.15], [0.5, 0.15]], [2.25, 2.25], 0.5, -1.0),  # .35 > 2 * .1 * 2.25 ** .5
        ([[0.5, 0.25], [0.5, 0.25]], [2.25, 2.25], 0.5, 1.0),  # .25 is less than that
    ],
)
def test_no_command_is_farther_from_the_plan_than_the_evidence_reaches(
    effects, variances, weight, action
):
    """The plan 1 has the effect .5, where -.5 is wanted; -1 promises an improvement of 1."""
    forecast = Forecast(
        torch.tensor(effects).view(1, 2, 2, 1),
        torch.tensor([[0.0, x] for x in variances]).view(1, 2, 2, 1),
    )
    models = Models([], torch.tensor([weight, 1 - weight]).view(1, 2, 1))
    proposals, one = torch.tensor([[[1.0], [-1.0]]]), torch.ones(1, 1)
    executed, _ = flow_of().choose(models, proposals, forecast, -0.5 * one, 0.1 * one)
    assert executed == action


def test_an_axis_that_hardly_moves_does_not_keep_the_others_from_it():
    """Together they do better, although the second, which moves by .01, does worse."""
    effects = torch.tensor([[[[0.5, 0.0], [0.0, 0.01]]]])
    models = Models([], torch.ones(1, 1, 2))
    actions = torch.tensor([[[0.5, 0.0], [-0.5, 0.01]]])
    nothing = torch.zeros(1, 2)
    _, axis, whole = flow_of().rate(models, actions, sure(effects), nothing, 0.1 + nothing)
    assert axis[0].tolist() == [[True, True], [True, False]]
    assert whole[0].flatten().tolist() == [True, True]


@pytest.mark.parametrize(("acts", "command"), [(0.3, None), (0.9, 1.0), (-0.9, -1.0)])
def test_a_slow_actuator_is_led_as_far_as_the_box_allows(acts, command):
    flow = flow_of()
    weights = torch.tensor([name == "lag_2" for name in flow.models]).to(flow.filter_of_model)
    lag = (flow.filter_of_model @ weights).argmax().view(1, 1)
    sent, box = torch.full((1, 20, 1), 0.1), torch.tensor([[[-1.0], [1.0]]])
    share = 1 - math.exp(-1 / 2)
    found, led_to = flow.lead(torch.tensor([[acts]]), lag, sent, box)
    expected = (acts - (1 - share) * 0.1) / share if command is None else command
    torch.testing.assert_close(found, torch.tensor([[expected]]))
    torch.testing.assert_close(led_to, torch.tensor([[share * expected + (1 - share) * 0.1]]))


@pytest.mark.parametrize(("healthy", "executed"), [(0.6, 0.5), (0.4, -0.5)])
def test_models_by_which_nothing_is_wrong_keep_the_plan(healthy, executed):
    flow, plan = flow_of(), torch.tensor([[0.5]])
    weights = torch.zeros(1, len(flow.models), 1)
    weights[:, flow.models.index("sensor noise")] = healthy
    weights[:, flow.models.index("reversed")] = 1 - healthy
    flow.weights = lambda fields: weights
    box = torch.tensor([[[-1.0], [1.0]]])
    memory = flow.core_of(flow.begin(torch.zeros(1, 1)))
    _, action, *_, corrects = flow.decide(memory, Plan(plan, box))
    torch.testing.assert_close(action, torch.tensor([[executed]]), rtol=0, atol=1e-3)
    assert corrects == (healthy < 0.5)


def test_maps_that_mix_axes_are_of_the_present_command_whatever_delay_is_believed():
    flow = flow_of(2)
    fields = fields_of(flow)
    fields["pairs"][:, -2:, :2] = torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    fields["delay"] = torch.tensor([[2.0]])
    now, weights = torch.tensor([[0.7, 0.8]]), flow.weights(fields)
    forecasts, _ = flow.forecast(fields, flow.fit(fields), weights, now)
    # nothing is known: every fit is nominal
    of = dict(zip(flow.models, forecasts[0], strict=True))
    for name, command in (("affine", now[0]), ("swapped", now[0]), ("line", [0.1, 0.2])):
        torch.testing.assert_close(of[name], torch.as_tensor(command))


def test_a_new_hypothesis_is_a_function_and_a_row(monkeypatch):
    """It is in the belief, it says the cause, and its answer is executed."""

    def half_turned(rows):
        quarter = torch.full_like(rows.noise, -0.25)
        return Line(quarter, 0.3 + 0 * quarter, quarter.new_zeros(*quarter.shape, 2, 2))

    row = Hypothesis("half turned", "line", half_turned, cause="a worn gear")
    monkeypatch.setattr(hypotheses, "HYPOTHESES", (*hypotheses.HYPOTHESES, row))
    flow, memory = flow_of(), None
    state = torch.zeros(1)
    memory = flow.begin(state)
    model = KnownDynamics(lambda s, u: s + u, Manifold(1), 1)
    box = torch.tensor([[-1.0], [1.0]])
    for plan in 0.3 + 0.2 * torch.rand(12, 1, generator=torch.Generator().manual_seed(0)):
        memory, correction = flow.correct(memory, plan, model, box)
        state = state - 0.25 * correction.executed + 0.3
        memory = flow.observe(memory, state)
    assert "half turned" in flow.models and flow.cause_in(memory) == "a worn gear"
    torch.testing.assert_close(0.3 - 0.25 * correction.executed, plan, rtol=0, atol=0.02)
