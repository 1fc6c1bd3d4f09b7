"""Planners are policies for any batch-unlocked environment."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.planning import CEM, ICEM, MPC, MPPI, GoalDistance, PlanningEnv, TorchRLMPPI

OURS = [MPPI, ICEM]
ALL = [*OURS, CEM, TorchRLMPPI]
SETTINGS = {"horizon": 6, "population": 200, "iterations": 3}


class Slider(EnvBase):
    """A point on a line that shall go to 1: somebody else's environment, with keys of its own."""

    def __init__(self, action_key=("robot", "push"), state_key=("robot", "place"), unlocked=True):
        super().__init__(batch_size=())
        self._batch_locked = not unlocked
        self.state_key = state_key
        self.observation_spec = Composite({state_key: Unbounded((1,))})
        self.state_spec = Composite({state_key: Unbounded((1,))})
        self.action_place = action_key
        self.full_action_spec = Composite({action_key: Bounded(-0.3, 0.3, (1,))})
        self.full_reward_spec = Composite({("robot", "gain"): Unbounded((1,))})

    def _reset(self, tensordict, **kwargs):
        batch = () if tensordict is None else tensordict.batch_size
        return self.observation_spec.zero(batch)

    def _step(self, tensordict):
        place = tensordict[self.state_key] + tensordict[self.action_place]
        out = TensorDict({self.state_key: place}, tensordict.batch_size)
        out["robot", "gain"] = -(place - 1).abs()
        out["done"] = torch.zeros_like(place, dtype=torch.bool)
        return out.set("terminated", out["done"].clone())

    def _set_seed(self, seed):
        pass


@pytest.mark.parametrize("kind", OURS)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_an_environment_with_keys_of_its_own(kind, batch):
    env = Slider()
    check_env_specs(env)
    more = {"memory_key": ["my", "plan"]} if kind is ICEM else {"mean_key": ["my", "plan"]}
    planner = kind(env, **SETTINGS, action_key=["robot", "push"], **more)
    assert planner.backend == "env" and planner.out_keys[0] == ("robot", "push")
    whole = TransformedEnv(env, planner.make_tensordict_primer())
    td = whole.reset(TensorDict(batch_size=batch), set_state=False)
    for _ in range(8):
        td = whole.step_mdp(whole.step(planner(td)))
    torch.testing.assert_close(td["robot", "place"], torch.ones(*batch, 1), rtol=0, atol=0.1)


@pytest.mark.parametrize("kind", [CEM, TorchRLMPPI])
def test_torchrls_own_refuse_other_keys(kind):
    with pytest.raises(ConfigurationError, match=r"write 'action', but Slider reads .*'push'"):
        kind(Slider())


@pytest.mark.parametrize("kind", ALL)
def test_an_environment_with_a_locked_batch_is_refused(kind):
    with pytest.raises(ValueError, match="batch_locked"):
        kind(Slider("action", unlocked=False))


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(
    "explore", [None, ExplorationType.RANDOM, ExplorationType.DETERMINISTIC], ids=str
)
def test_any_exploration_type_gives_an_action_in_the_box(box, kind, explore):
    world = PlanningEnv(Dubins(), GoalDistance(), *box)
    planner = kind(world, horizon=3, population=60)
    with set_exploration_type(explore):
        data = (
            world.rollout(2, planner)
            if kind in ALL[2:]
            else _primed(world, planner).rollout(2, planner)
        )
    assert ((data["action"] >= box[0]) & (data["action"] <= box[1])).all()


def _primed(world, planner):
    keeps = hasattr(planner, "make_tensordict_primer")
    return TransformedEnv(world, planner.make_tensordict_primer()) if keeps else world


def test_mppi_gives_its_mean_whatever_the_exploration_type(box):
    world = PlanningEnv(Dubins(), GoalDistance(), *box)
    for explore in (ExplorationType.MEAN, ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        planner = MPPI(world, horizon=3, population=20)
        with set_exploration_type(explore):
            td = planner(_primed(world, planner).reset())
        torch.testing.assert_close(td["action"], td["next", "mppi", "mean"][0])


def test_several_actions_are_refused():
    env = Slider()
    env.full_action_spec = Composite(left=Bounded(-1.0, 1.0, (1,)), right=Bounded(-1.0, 1.0, (1,)))
    with pytest.raises(ConfigurationError, match=r"takes the actions .*'left', 'right'"):
        MPPI(env)


def test_a_planner_without_a_quadratic_cost_is_refused():
    with pytest.raises(ConfigurationError, match="MPC needs a PlanningEnv with a quadratic cost"):
        MPC(Slider())
