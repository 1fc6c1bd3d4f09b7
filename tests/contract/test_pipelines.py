"""The transform in collectors and worker processes, with terminal states and compiled."""

import copy
import os
import pickle

import gymnasium
import pytest
import torch
from pushing import Car
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, GymWrapper, TransformedEnv, VecGymEnvTransform
from torchrl.envs.utils import step_mdp
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from afm_rl.correction import LeastSquares
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam, Updater
from afm_rl.planning import ICEM, MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform

REVERSED = {"schedule": Schedule([]), "missions": {"regime": {"v_gain": -1.0}}}


def afm(box, model=None):
    return ActionFlowTransform(model or Dubins(), LeastSquares(*box))


def car(box, *more, batch=(), model=None, **settings):
    base = UGVTrack(batch_size=batch, process_noise=0.0, **{**REVERSED, **settings})
    return TransformedEnv(base, Compose(afm(box, model), *more))


def collected(env, policy=None, frames=20, kind=Collector, **settings):
    """Return what a collector gives at once."""
    collector = kind(env, policy, frames_per_batch=frames, total_frames=frames, **settings)
    try:
        (data,) = list(collector)
    finally:
        collector.shutdown()
    return data


def buffer_of(data):
    """Return a buffer of all steps, of which a sample has all."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(24), batch_size=data.numel())
    buffer.extend(data.reshape(-1))
    return buffer


@pytest.mark.parametrize("kind", [MPPI, ICEM])
def test_a_collector_fills_a_buffer_with_plans_and_what_was_executed(box, kind):
    planner = kind(PlanningEnv(Dubins(), GoalDistance(), *box), horizon=3, candidates=20)
    primer = planner.make_tensordict_primer()
    env = car(box, primer, batch=(2,), max_steps=5)
    sample = buffer_of(collected(env, planner, 12)).sample()
    memory = sample["next", "afm"]
    assert torch.equal(memory["planned_action"], sample["action"])
    apart = (memory["executed_action"] != sample["action"]).any(-1)
    assert torch.equal(apart, memory["corrected"]) and apart.any()
    valid = env.transform[0].memory["valid"]
    assert (valid.sum((-2, -1)) == 1).all()  # the sixth step is the first of an episode


CHEETAH = KnownDynamics(lambda s, a: s + 0.05 * torch.cat([s[..., :11], a], -1), Manifold(17), 6)


def corrected(env):
    """Collect from a policy that corrects itself."""
    policy = ActionFlowPolicy(CHEETAH, env.action_spec)
    whole = TransformedEnv(env.base_env, policy.make_tensordict_primer())
    planner = TensorDictModule(lambda s: s[..., :6].float(), ["observation"], ["action"])
    return collected(whole, TensorDictSequential(planner, policy))


SOURCES = {
    "collector": collected,
    "rollout": lambda env: env.rollout(20),
    "rollout that continues": lambda env: env.rollout(20, break_when_any_done=False),
    "policy": corrected,
}


@pytest.mark.parametrize("source", SOURCES)
def test_memories_are_no_part_of_replay_data(source):
    """On HalfCheetah, whose states are in double precision."""
    pytest.importorskip("mujoco")
    env = TransformedEnv(GymEnv("HalfCheetah-v5"), ActionFlowTransform(CHEETAH))
    steps = buffer_of(SOURCES[source](env))[:]
    size = sum(value.nbytes for value in steps.values(True, True)) / 20  # bytes
    assert size <= 1500


@pytest.mark.parametrize("mode", ["SAME_STEP", "DISABLED"])
def test_vectorised_gymnasium_environments_keep_terminal_states(mode):
    mode = gymnasium.vector.AutoresetMode(getattr(gymnasium.vector.AutoresetMode, mode))
    envs = gymnasium.vector.SyncVectorEnv([lambda: Car(ends=4)] * 2, autoreset_mode=mode)
    chain = [VecGymEnvTransform()] if mode is gymnasium.vector.AutoresetMode.SAME_STEP else []
    box = -torch.ones(2), torch.ones(2)
    env = TransformedEnv(GymWrapper(envs), Compose(*chain, afm(box)))
    data = env.rollout(9, break_when_any_done=False)
    assert data["next", "done"].sum() >= 4
    assert float(data["next", "afm", "innovation"].max()) < 0.1


@pytest.mark.slow
def test_a_compiled_environment_steps_alike(box):
    base = UGVTrack(batch_size=(3,), process_noise=0.0, **REVERSED)
    env = TransformedEnv(base, Compose(afm(box)))
    start = env.rollout(3)[:, -1]
    td = step_mdp(start).set("action", torch.full((3, 2), 0.4))
    expected = copy.deepcopy(env).step(td.clone())
    torch._dynamo.reset()
    transform = env.transform[0]
    compiled = torch.compile(transform._inv_call, backend="eager")
    executed = compiled(td.clone())["action"]
    torch.testing.assert_close(executed, expected["next", "afm", "executed_action"])
    assert expected["next", "afm", "corrected"].all()


def taught(box, make_ensemble):
    model = make_ensemble()
    updater = OnlineUpdater(GaussianNLLLoss(model), lambda p: ResetAdam(p, lr=1e-3))
    return model, updater


def test_a_model_that_learns_elsewhere_is_refused(box, make_ensemble, monkeypatch):
    model, updater = taught(box, make_ensemble)
    env = car(box, model=model)
    env.reset()
    there = os.getpid() + 1
    monkeypatch.setattr(os, "getpid", lambda: there)  # the copy in a worker process
    with pytest.raises(ConfigurationError, match="learns in another process.* ParallelEnv"):
        env.reset()
    frozen = make_ensemble()
    Updater(GaussianNLLLoss(frozen))
    car(box, model=frozen).reset()


def test_an_updater_that_moves_takes_its_model_along(make_ensemble, box, monkeypatch):
    updater = Updater(GaussianNLLLoss(make_ensemble()))
    assert pickle.loads(pickle.dumps(updater)).loss.model.taught_in is None
    _, updater = taught(box, make_ensemble)
    stored, there = pickle.dumps(updater), os.getpid() + 1
    monkeypatch.setattr(os, "getpid", lambda: there)
    moved = pickle.loads(stored)
    car(box, model=moved.loss.model).reset()
    assert copy.deepcopy(moved).loss.model.taught_in == there


@pytest.mark.slow
@pytest.mark.timeout(400)  # workers import everything again
def test_worker_processes_with_a_frozen_model(box):
    def make():
        return car(box, model=Dubins(), max_steps=3)

    data = collected([make], None, 6, MultiSyncCollector, cat_results=0)
    memory = data["next", "afm"]
    assert torch.equal(memory["planned_action"], data["action"])
    assert not torch.equal(memory["executed_action"], data["action"])


def test_losses_of_policies_see_the_planned_action(box):
    """Its log-probability is stored."""
    net = torch.nn.Sequential(MLP(3, 4, num_cells=[16]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs=dict(zip(("low", "high"), box, strict=True)),
        return_log_prob=True,
    )
    data = collected(car(box, batch=(2,)), actor, 24)
    value = ValueOperator(MLP(3, 1, num_cells=[16]))
    GAE(gamma=0.99, lmbda=0.95, value_network=value)(data)
    executed, ratios = ("next", "afm", "executed_action"), {}
    for key in ("action", executed):
        loss = ClipPPOLoss(actor, value)
        loss.set_keys(action=key)
        ratios[key] = float(loss(data)["max_ratio"])
    assert ratios["action"] == pytest.approx(1.0, abs=1e-4) and ratios[executed] > 1.1
