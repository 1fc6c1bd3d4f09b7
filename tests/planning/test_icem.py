"""The improved cross-entropy method: its noise, its elites, its actions."""

import pytest
import torch
from harness import situation
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from afm_rl.dynamics import Dubins
from afm_rl.planning import ICEM, GoalDistance, PlanningEnv, icem
from afm_rl.planning.icem import coloured

SMALL = {"horizon": 4, "candidates": 32, "elites": 6, "iterations": 2}


def robots(*batch):
    return situation(*batch, name="icem", mean=(4, 2), elites=(2, 4, 2))


def spy(world):
    """Record the candidates and returns of each iteration."""
    real, seen = world.returns, []

    def returns(state, plans, *task):
        seen.append((plans.clone(), real(state, plans, *task)))
        return seen[-1][1]

    world.returns = returns
    return seen


@pytest.mark.parametrize("steps", [1, 2, 5, 8])
@pytest.mark.parametrize("beta", [0.0, 1.0, 2.5])
def test_coloured_noise_has_unit_variance_and_the_spectrum_asked_for(steps, beta):
    noise = coloured(torch.randn(200_000, steps, 1, dtype=torch.float64), beta).squeeze(-1)
    torch.testing.assert_close(noise.var(0), torch.ones(steps).double(), rtol=0.03, atol=0)
    power = torch.fft.rfft(noise).abs().square().mean(0)
    frequency = torch.fft.rfftfreq(steps).clamp_min(1 / steps).double() ** -beta
    torch.testing.assert_close(power / power[0], frequency / frequency[0], rtol=0.03, atol=0)


def test_the_population_shrinks_but_not_below_twice_the_elites(world):
    planner = ICEM(world, candidates=60, iterations=4, elites=20)
    assert planner.counts == [60, 48, 40, 40]
    seen = spy(world)
    planner(planner.make_tensordict_primer()(robots(2)))
    assert [plans.shape[-3] for plans, _ in seen] == planner.counts


def test_elites_go_on_and_the_mean_joins_last(world, box):
    seen, td = spy(world), robots(3)
    out = ICEM(world, **SMALL)(td.clone())
    (first, worth), (second, _) = seen
    before = td["icem", "elites"]
    shifted = torch.cat([before[..., 1:, :], before[..., -1:, :]], -2)
    torch.testing.assert_close(first[:, :2], shifted.clamp(*box))
    best = worth.topk(2).indices[..., None, None].expand(3, 2, 4, 2)
    torch.testing.assert_close(second[:, :2], first.gather(1, best))
    elites = first.gather(1, worth.topk(6).indices[..., None, None].expand(3, 6, 4, 2))
    shifted = torch.cat([td["icem", "mean"][:, 1:], td["icem", "mean"][:, -1:]], 1)
    torch.testing.assert_close(second[:, 2], 0.9 * elites.mean(1) + 0.1 * shifted)
    best = seen[1][1].topk(2).indices[..., None, None].expand(3, 2, 4, 2)
    torch.testing.assert_close(out["next", "icem", "elites"], second.gather(1, best))


def test_the_noise_shrinks_to_the_spread_of_the_elites(monkeypatch):
    monkeypatch.setattr(icem, "MOMENTUM", 0.0)
    monkeypatch.setattr(icem, "DECAY", 1.0)
    world = PlanningEnv(Dubins(), GoalDistance(), [-100.0, -100.0], [100.0, 100.0])
    settings = {**SMALL, "candidates": 4000, "sigma": 0.005}
    planner = ICEM(world, **settings, beta=0.0)
    seen = spy(world)
    planner(robots(1))
    (first, worth), (second, _) = seen
    torch.testing.assert_close(first[0, 2:].std(0), torch.full((4, 2), 0.5), atol=0.03, rtol=0)
    spread = first[0, worth[0].topk(6).indices].std(0, correction=0)
    torch.testing.assert_close(second[0, 3:].std(0), spread, rtol=0.05, atol=0)


def test_a_new_mission_starts_from_the_middle_of_the_box():
    world = PlanningEnv(Dubins(), GoalDistance(), [0.5, -1.0], [1.5, 2.0])
    planner = ICEM(world, **SMALL, sigma=0.0)
    memory = planner(planner.make_tensordict_primer()(robots(2)))["next", "icem"]
    torch.testing.assert_close(memory["mean"], torch.tensor([1.0, 0.5]).expand(2, 4, 2))
    torch.testing.assert_close(memory["elites"], torch.tensor([1.0, 0.5]).expand(2, 2, 4, 2))


KINDS = {
    None: "best",
    ExplorationType.RANDOM: "best",
    ExplorationType.MEAN: "mean",
    ExplorationType.DETERMINISTIC: "mean",
}


@pytest.mark.parametrize(("kind", "wanted"), KINDS.items(), ids=str)
def test_the_exploration_type_chooses_between_best_and_mean(world, kind, wanted):
    with set_exploration_type(kind):
        out = ICEM(world, **SMALL)(robots(4))
    memory = out["next", "icem"]
    expected = {"best": memory["elites"][:, 0, 0], "mean": memory["mean"][:, 0]}
    torch.testing.assert_close(out["action"], expected[wanted])
    assert not torch.allclose(*expected.values())


def test_an_action_is_held_as_long_as_plans_say(world):
    planner = ICEM(world, **SMALL, hold=3)
    seen, env = spy(world), TransformedEnv(world, planner.make_tensordict_primer())
    start = env.reset(robots(2).exclude("icem"))
    actions = env.rollout(7, planner, auto_reset=False, tensordict=start)["action"]
    assert len(seen) == 3 * SMALL["iterations"]  # plans are made at the steps 0, 3 and 6
    assert [len(actions[0, a:b].unique(dim=0)) for a, b in ((0, 3), (3, 6), (2, 4))] == [1, 1, 2]
    plans = seen[0][0]
    assert plans.shape[-2] == 3 * SMALL["horizon"]
    assert torch.equal(plans[..., ::3, :], plans[..., 2::3, :])
    best = seen[1][1].argmax(-1)
    assert torch.equal(actions[:, 0], seen[1][0][torch.arange(2), best, 0])
