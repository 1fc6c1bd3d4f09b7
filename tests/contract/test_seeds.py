"""Whatever draws numbers draws those of its seed, and none of torch's global generator."""

import pytest
import torch
from harness import weights
from puck import Puck, push
from tensordict import TensorDict
from torchrl.envs import GymEnv, TransformedEnv

from afm_rl import check_model
from afm_rl.correction import PaperFlow
from afm_rl.correction.training import train_flow
from afm_rl.dynamics import KNODE, Dubins, Ensemble, Quadrotor
from afm_rl.envs import UGVTrack
from afm_rl.learning import collect, fit_ensemble
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import GainNoise
from afm_rl.spaces.manifold import Manifold, uniform
from afm_rl.streams import Streams
from afm_rl.transforms import RegimeTransform

ONE, TEN = torch.ones(2), torch.ones(10, 3)


def ensemble(**settings):
    return Ensemble(Manifold(3), 2, features=[2], members=2, hidden=[8], **settings)


def fitted(seed):
    rows = uniform(-TEN[0], TEN[0], 10, generator(0))
    entries = {"observation": rows, "action": rows[:, :2], ("next", "observation"): 2 * rows}
    model = ensemble()
    fit_ensemble(model, TensorDict(entries, [10]), seed=seed, epochs=2, batch_size=4)
    return weights(model)


def trained(seed):
    flow = PaperFlow(-ONE, ONE, [2], 3, gate=0.1, width=8)
    train_flow(flow, Dubins(), (-TEN[0], TEN[0]), iterations=4, batch_size=8, seed=seed)
    return weights(flow)


def planned(seed):
    planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), -ONE, ONE), 4, 32, seed=seed)
    td = TensorDict({"observation": TEN[0], "goal": 3 * ONE})
    return planner(planner.make_tensordict_primer()(td))["action"]


def driven(seed):
    env = UGVTrack(batch_size=(3,))
    env.set_seed(seed)
    data = env.reset().set("action", ONE.expand(3, 2))
    pose = env.step(data)["next", "pose"]
    env.render()
    return pose


def disturbed(seed):
    noisy = RegimeTransform(GainNoise(), [{"gain_noise": 0.1}], seed=seed)
    env = TransformedEnv(PlanningEnv(Dubins(), GoalDistance(), -ONE, ONE), noisy)
    td = env.reset(TensorDict({"observation": TEN, "goal": TEN[:, :2]}, [10]))
    effects = env.step(td.set("action", TEN[:, :2] / 2))["next", "regime", "effective_action"]
    assert len(effects.unique()) == 20
    return effects


def checked(seed):
    def steer(observation):
        seen.append(observation.tolist())
        return -observation[:2] - observation[2:]

    seen = []
    check_model(Puck(ends=99), push, steer, seed=seed)
    return torch.tensor(seen)


def generator(seed):
    return torch.Generator().manual_seed(seed)


DRAWN = {
    "collected actions": lambda seed: collect(GymEnv("Pendulum-v1"), frames=9, seed=seed)[:][
        "action"
    ],
    "a fitted ensemble": fitted,
    "a trained flow": trained,
    "weights of an ensemble": lambda seed: weights(ensemble(seed=seed)),
    "samples of an ensemble": lambda seed: ensemble(propagation="sample", seed=seed)(
        TEN, TEN[:, :2]
    ),
    "networks of a KNODE": lambda seed: (
        KNODE(Quadrotor(), seed=seed).push_().push_().networks.inner
    ),
    "plans": planned,
    "starts of a check": checked,
    "poses": driven,
    "effects under a regime": disturbed,
    "points": lambda seed: uniform(-ONE, ONE, 50, generator(seed)),
    "streams": lambda seed: Streams(seed=seed).normal((5,), bound=2.0),
    "streams of missions": lambda seed: Streams().normal((5,), seeds=torch.tensor([seed, 9]))[0],
}


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_the_seed_decides_and_the_global_generator_is_left_alone(draw):
    before, drawn = torch.get_rng_state(), []
    for seed in (3, 3, 4):
        drawn.append(draw(seed))
        assert torch.equal(torch.get_rng_state(), before)
        before = torch.manual_seed(7 * seed).get_state()  # must not matter
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
