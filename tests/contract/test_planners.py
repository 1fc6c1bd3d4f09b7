"""Planners are policies for any batch-unlocked environment."""

import math
import warnings

import pytest
import torch
from harness import situation
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from torchrl.modules import CEMPlanner
from torchrl.modules.planners.common import _mask_post_done_reward

from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import CEM, ICEM, MPPI, GoalDistance, KnownReward, PlanningEnv
from afm_rl.planning.receding import rewards_until_done
from afm_rl.spaces.manifold import Manifold

MEMORIES = {MPPI: ("mppi", "mean"), ICEM: ("icem", "mean")}
ALL = [*MEMORIES, CEM]
SETTINGS = {"horizon": 6, "candidates": 200, "iterations": 3}
PLACE, PUSH = ("robot", "place"), ("robot", "push")


class Slider(EnvBase):
    """A point on a line that shall go to 1: somebody else's environment, with keys of its own."""

    def __init__(self):
        super().__init__(batch_size=())
        self._batch_locked = False
        self.observation_spec = Composite({PLACE: Unbounded((1,))})
        self.state_spec = Composite({PLACE: Unbounded((1,))})
        self.full_action_spec = Composite({PUSH: Bounded(-0.3, 0.3, (1,))})
        self.full_reward_spec = Composite({("robot", "gain"): Unbounded((1,))})

    def _reset(self, tensordict, **kwargs):
        batch = () if tensordict is None else tensordict.batch_size
        return self.observation_spec.zero(batch)

    def _step(self, tensordict):
        place = tensordict[PLACE] + tensordict[PUSH]
        out = TensorDict({PLACE: place}, tensordict.batch_size)
        out["robot", "gain"] = -(place - 1).abs()
        out["done"] = torch.zeros_like(place, dtype=torch.bool)
        return out.set("terminated", out["done"].clone())

    def _set_seed(self, seed):
        pass


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_an_environment_with_keys_of_its_own(kind, batch):
    env = Slider()
    check_env_specs(env)
    planner = kind(env, **SETTINGS, action_key=[*PUSH])
    assert not planner.fast and planner.out_keys[0] == PUSH
    whole = TransformedEnv(env, planner.make_tensordict_primer())
    td = whole.reset(TensorDict(batch_size=batch), set_state=False)
    for _ in range(8):
        td = whole.step_mdp(whole.step(planner(td)))
    torch.testing.assert_close(td[PLACE], torch.ones(*batch, 1), rtol=0, atol=0.1)


class Cliff(PlanningEnv):
    """A point on a line that shall go far to the right: beyond 0.5 nothing is finite."""

    def __init__(self, beyond=math.nan):
        def reward(state, action, after):
            return torch.where(after[..., 0] > 0.5, beyond, after[..., 0])

        push = KnownDynamics(lambda state, action: state + action, Manifold(1), 1)
        super().__init__(push, KnownReward(reward), [-1.0], [1.0])

    def start(self, planner, count):
        td = TensorDict({"observation": torch.zeros(count, 1)}, [count])
        return planner.make_tensordict_primer()(td)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(
    ("fast", "beyond"), [(True, math.nan), (True, math.inf), (False, math.nan), (False, -math.inf)]
)
def test_nobody_steps_to_where_returns_are_not_finite(kind, fast, beyond):
    world = Cliff(beyond)
    elites = {} if kind is MPPI else {"elites": 8}
    planner = kind(world, horizon=3, candidates=200, **elites)
    planner.fast = fast
    action = planner(world.start(planner, 30))["action"]
    assert action.isfinite().all() and (action <= 0.5).all()
    assert action.mean() > 0.1 and planner.discarded > 0


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(
    ("lost", "fault"), [(1, math.inf), (16, math.nan), (31, -math.inf), (32, math.nan)]
)
def test_returns_that_are_not_finite_are_ignored(box, kind, lost, fault):
    def plan(lost):
        world = PlanningEnv(Dubins(), GoalDistance(), *box)
        planner, real = kind(world, horizon=5, candidates=32, iterations=1), world.returns

        def faulty(*given):
            returns = real(*given)
            returns[1, :lost] = fault
            return returns

        world.returns = faulty
        return planner, planner(td.clone())

    td = TensorDict({"observation": torch.zeros(2, 3), "goal": torch.ones(2, 2)}, [2])
    if kind in MEMORIES:
        td[MEMORIES[kind]] = 0.1 * torch.randn(2, 5, 2)
    td["icem", "elites"] = 0.1 * torch.randn(2, 3, 5, 2)
    _, sound = plan(0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        planner, out = plan(lost)
    assert planner.discarded == lost
    assert all(entry.isfinite().all() for entry in out.values(True, True))
    torch.testing.assert_close(out["action"][0], sound["action"][0])  # it notices nothing
    if kind is ICEM and lost == 31:  # no plan that was lost is remembered
        elites = out["next", "icem", "elites"][1]
        assert torch.equal(elites, elites[:1].expand_as(elites))
    told = [str(warning.message) for warning in caught]
    if lost < 32:
        assert told == []
        return
    assert told == ["planner: no finite return for 1 of 2 plans; the previous plan is kept"]
    for key in planner.memory:
        before, after = td[key][1], out["next", key][1]
        assert torch.equal(torch.cat([before[..., 1:, :], before[..., -1:, :]], -2), after)
    if kind not in MEMORIES:
        assert (out["action"][1] == 0).all()


@pytest.mark.filterwarnings("ignore:planner. no finite return")
@pytest.mark.parametrize(
    ("explore", "iterations"), [(ExplorationType.RANDOM, 3), (ExplorationType.DETERMINISTIC, 1)]
)
@pytest.mark.parametrize("kind", MEMORIES)
def test_where_every_rollout_is_lost_the_previous_plan_is_executed(kind, iterations, explore):
    world = Cliff()
    world.returns = lambda state, plans, *task: plans[..., 0, 0] * math.nan
    planner = kind(world, horizon=3, candidates=60, iterations=iterations)
    td, plan = world.start(planner, 2), torch.tensor([[0.7], [-0.4], [0.9]])
    td[MEMORIES[kind]] = plan.expand(2, 3, 1).clone()
    for _ in range(2):  # then the last action of the plan is repeated
        with set_exploration_type(explore):
            out = planner(td)
        plan = torch.cat([plan[1:], plan[-1:]])
        assert torch.equal(out["action"], plan[0].expand(2, 1))
        assert torch.equal(out["next", *MEMORIES[kind]], plan.expand(2, 3, 1))
        td = out["next"].select(*planner.memory).set("observation", td["observation"])


@pytest.mark.filterwarnings("ignore:planner. no finite return")
@pytest.mark.parametrize("kind", [MPPI, CEM])
def test_an_iteration_that_is_lost_changes_nothing(kind):
    def plan(iterations):
        world, count = Cliff(), iter([1.0, 1.0, math.nan])
        real = world.returns
        world.returns = lambda *given: next(count) * real(*given)
        planner = kind(world, horizon=3, candidates=100, iterations=iterations)
        return planner(world.start(planner, 4))["action"]

    assert torch.equal(plan(2), plan(3))


@pytest.mark.filterwarnings("ignore:planner. no finite return")
@pytest.mark.parametrize("kind", ALL)
def test_without_any_finite_return_actions_are_in_the_box(kind):
    world = PlanningEnv(Dubins(), GoalDistance(), [0.2, -1.0], [1.0, -0.5])
    world.returns = lambda state, plans, *task: plans[..., 0, 0] * math.nan
    planner = kind(world, horizon=3, candidates=60)
    td = TensorDict({"observation": torch.zeros(3, 3), "goal": torch.ones(3, 2)}, [3])
    td = planner.make_tensordict_primer()(td)
    for action in (planner.planning(td), planner(td)["action"]):
        assert all(world.action_spec.is_in(row) for row in action)


@pytest.mark.parametrize("kind", ALL)
def test_a_planner_of_ones_own_overrides_plan_and_nothing_else(world, kind):
    class Still(kind):
        def plan(self, td):
            action, memory = super().plan(td)
            return 0 * action, memory

    planner = Still(world, horizon=5, candidates=60)
    data = TransformedEnv(world, planner.make_tensordict_primer()).rollout(3, planner)
    assert (data["action"] == 0).all()
    assert (planner.planning(data[0].exclude("action")) == 0).all()
    for name in ("planning", "_plan"):
        ignored = type("Ignored", (kind,), {name: lambda self, td: 0 * super().planning(td)})
        with pytest.raises(ConfigurationError, match=r"Ignored overrides .*override plan\(td\)"):
            ignored(world, horizon=5, candidates=60)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(("scale", "shift"), [(1e-8, 0.0), (1e8, 0.0), (1.0, 1e6)])
def test_any_scale_of_the_cost_gives_an_action_in_the_box(kind, scale, shift):
    world = Cliff()
    real, world.returns = world.returns, lambda *given: scale * real(*given) - shift
    planner = kind(world, horizon=3, candidates=40)
    action = planner(world.start(planner, 8))["action"]
    assert (action.abs() <= 1).all()


@pytest.mark.parametrize("batch", [(), (3,)])
def test_torchrls_rule_gives_the_plans_of_torchrls_planner(world, batch):
    td = TensorDict({"observation": torch.randn(*batch, 3), "goal": torch.ones(*batch, 2)}, batch)
    theirs, ours = CEMPlanner(world, 4, 3, 60, 8), CEM(world, 4, 60, 3, 8)
    ours._noise = lambda td, like, count: torch.randn(*batch, count, *like.shape[-2:])
    torch.manual_seed(0)
    expected = theirs(td.clone())["action"]
    torch.manual_seed(0)
    torch.testing.assert_close(ours(td)["action"], expected)


def test_rewards_end_with_the_episode_as_in_torchrl_s_planners():
    done = torch.rand(4, 3, 6, 1) < 0.2
    reward = torch.where(done.cumsum(-2) > 2, math.nan, torch.randn(4, 3, 6, 1))
    data = TensorDict({"next": {"reward": reward, "done": done}}, [4, 3, 6])
    expected = _mask_post_done_reward(data)
    torch.testing.assert_close(rewards_until_done(data["next"], "reward", ["done"]), expected)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("explore", [None, *ExplorationType], ids=str)
def test_any_exploration_type_gives_an_action_in_the_box(world, kind, explore):
    planner = kind(world, horizon=3, candidates=60)
    with set_exploration_type(explore):
        data = TransformedEnv(world, planner.make_tensordict_primer()).rollout(2, planner)
    low, high = world.action_spec.space.low, world.action_spec.space.high
    assert ((data["action"] >= low) & (data["action"] <= high)).all()
    if kind is MPPI:  # its mean, whatever the type
        torch.testing.assert_close(data["action"], data["next", "mppi", "mean"][:, 0])


@pytest.mark.parametrize(("kind", "settings"), [(MPPI, {}), (ICEM, {"elites": 6, "hold": 2})])
def test_plans_keep_to_a_box_per_mission(world, box, kind, settings):
    """As long as an action is held, too: at last the boxes shrink before it ends."""
    (low, high), name, key = box, MEMORIES[kind][0], ("afm", "effect_bounds")
    planner = kind(world, 4, 256, bounds_key=list(key), **settings)
    td = planner.make_tensordict_primer()(situation(3, name=name).exclude(name))
    wide, narrow = torch.stack([low, 2.5 * high]), torch.stack([0.2 * low, 0.1 * high])
    td["goal"] *= 100
    td[key] = torch.stack([wide, narrow, torch.zeros(2, 2)])
    out = planner(td.clone())
    plans = [out["next", name, plan].flatten(1, -2) for plan in out["next", name].keys() - {"held"}]
    later = td.clone().set(name, out["next", name]).set(key, 0.1 * td[key])
    for planned, size in (
        *((plan, 1.0) for plan in (out["action"].unsqueeze(-2), *plans)),
        (planner(later)["action"].unsqueeze(-2), 0.1),
    ):
        least, most = (size * td[key]).unsqueeze(-3).unbind(-2)
        assert (planned >= least - 1e-6).all() and (planned <= most + 1e-6).all()
    assert key in planner.in_keys and (out["action"][0] > high).any()


PLANS = {
    "MPPI": (MPPI, {}),
    "MPPI in three iterations": (MPPI, {"iterations": 3}),
    "MPPI with noise of unit size": (MPPI, {"noise": "unit"}),
    "ICEM": (ICEM, {"elites": 6, "iterations": 2}),
}


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)], ids=str)
def test_both_backends_plan_the_same_also_alone(box, name, batch):
    # In double precision: plans of several iterations amplify how sums are rounded.
    world = PlanningEnv(Dubins().double(), GoalDistance(), *(end.double() for end in box))
    kind, settings = PLANS[name]
    fast, slow, alone = (kind(world, 4, 32, seed_key="seed", **settings) for _ in range(3))
    slow.fast = False
    memory = {key[-1]: shape for key, shape in fast.memory.items()}
    td = situation(*batch, name=name[:4].lower(), **memory).double()
    td["seed"] = torch.arange(math.prod(batch)).reshape(batch) % 2
    for _ in range(2):
        found = fast(td.clone())
        torch.testing.assert_close(slow(td.clone()), found, rtol=0, atol=1e-10)
        index = (0,) * len(batch)
        torch.testing.assert_close(alone(td[index].clone()), found[index], rtol=0, atol=1e-10)


DRIVERS = {
    "MPPI": lambda world: MPPI(world, 8, 100),
    "MPPI in two iterations": lambda world: MPPI(world, 8, 100, iterations=2, beta=1.0),
    "MPPI with noise of unit size": lambda world: MPPI(world, 8, 100, noise="unit"),
    "ICEM": lambda world: ICEM(world, 8, 64),
    "CEM": lambda world: CEM(world, 4, 60, iterations=3, elites=8),
}


@pytest.mark.parametrize("name", DRIVERS)
def test_it_drives_to_the_goal(world, name):
    planner, td = DRIVERS[name](world), TensorDict(batch_size=[3])
    td["observation"] = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [1.0, 1.0, -1.5]])
    td["goal"] = torch.tensor([[2.0, 1.0], [2.0, 0.0], [-1.0, 0.0]])
    td, gaps = planner.make_tensordict_primer()(td), []
    for _ in range(40):
        td = world.step_mdp(world.step(planner(td)))
        gaps.append((td["observation"][:, :2] - td["goal"]).norm(dim=-1))
    assert (torch.stack(gaps).amin(0) < 0.2).all()


def test_several_actions_are_refused():
    env = Slider()
    env.full_action_spec = Composite(left=Bounded(-1.0, 1.0, (1,)), right=Bounded(-1.0, 1.0, (1,)))
    with pytest.raises(ConfigurationError, match=r"takes the actions .*'left', 'right'"):
        MPPI(env)
