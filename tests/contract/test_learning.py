"""Losses in a trainer; updaters in loops, collectors and trainers alike."""

import copy
from functools import partial

import pytest
import torch
from harness import weights
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import RandomPolicy
from torchrl.trainers import ReplayBufferTrainer, Trainer

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam, Updater, UpdaterHook
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv


def updater_of(model):
    return OnlineUpdater(GaussianNLLLoss(model), partial(ResetAdam, lr=1e-3))


def agent(model, box):
    """An environment and a planner that shares the model."""
    planner = MPPI(PlanningEnv(model, GoalDistance(), *box), 3, 12, seed_key=["mission", "seed"])
    base = UGVTrack(batch_size=(2,), max_steps=5)
    return TransformedEnv(base, Compose(planner.make_tensordict_primer())), planner


def collected(model, box, steps, place, **settings):
    env, planner = agent(model, box)
    hook = UpdaterHook(updater_of(model))
    collector = Collector(
        *(env, planner),
        **{"total_frames": 2 * steps, "use_buffers": False, place: hook, **settings},
    )
    data = torch.cat([batch.clone() for batch in collector], -1)
    collector.shutdown()
    return data


def test_a_collector_with_the_hook_is_the_loop(make_ensemble, box):
    models = [make_ensemble() for _ in range(2)]
    env, planner = agent(models[0], box)
    updater, td, losses = updater_of(models[0]), env.reset(), []
    for _ in range(7):
        whole, td = env.step_and_maybe_reset(planner(td))
        losses.append(updater(whole)["loss"])
    data = collected(models[1], box, 7, "postproc", frames_per_batch=2)
    torch.testing.assert_close(data["updater_loss"], torch.stack(losses, -1))
    torch.testing.assert_close(weights(models[1]), weights(models[0]))


@pytest.mark.parametrize("place", ["postproc", "post_collect_hook"])
def test_longer_batches_teach_each_transition_once_oldest_first(make_ensemble, box, place):
    model, other = make_ensemble(), make_ensemble()
    data = collected(model, box, 8, place, frames_per_batch=8)
    updater = updater_of(other)
    for row in data.unbind(-1):
        updater(row)
    torch.testing.assert_close(weights(other), weights(model))


def test_the_hook_starts_the_updater_once():
    class Counting(Updater):
        started = 0

        def start(self, tensordict):
            self.started += 1

    updater = Counting(GaussianNLLLoss(Dubins()))
    hook, data = UpdaterHook(updater, ["my", "loss"]), UGVTrack(batch_size=(2,)).rollout(3)
    for _ in range(2):
        assert hook(data)["my", "loss"].shape == (2, 3)
    assert updater.started == 1
    with pytest.raises(ConfigurationError, match=r"shape \(\); expected \(\*B, T\)"):
        hook(data[0, 0])


def test_the_hook_keeps_its_state(make_ensemble):
    data = UGVTrack(batch_size=(2,)).rollout(4)
    first, second = (
        UpdaterHook(OnlineUpdater(GaussianNLLLoss(make_ensemble(seed=seed)), torch.optim.Adam))
        for seed in (0, 1)
    )
    first(data.clone())
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    again = [hook(data.clone())["updater_loss"] for hook in (first, second)]
    torch.testing.assert_close(*again)
    frozen = UpdaterHook(Updater(GaussianNLLLoss(Dubins())))
    frozen.load_state_dict(frozen.state_dict())


def test_a_trainer_descends_the_likelihood_and_calls_the_hook_with_every_batch(make_ensemble):
    models, env, seen = [make_ensemble(), make_ensemble()], UGVTrack(batch_size=(2,)), []
    before, loss = weights(models[0]), GaussianNLLLoss(models[0])
    driver = RandomPolicy(env.action_spec)
    trainer = Trainer(
        collector=Collector(env, driver, frames_per_batch=8, total_frames=24),
        total_frames=24,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        progress_bar=False,
    )
    UpdaterHook(updater_of(models[1])).register(trainer)
    assert trainer.state_dict()["updater"].keys() == {"updater", "started"}
    trainer.register_op("batch_process", lambda batch: seen.append(batch["updater_loss"]))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(24), batch_size=8)
    ReplayBufferTrainer(buffer, flatten_tensordicts=True).register(trainer)
    trainer.train()
    assert [loss.shape for loss in seen] == [(2, 4)] * 3 and len(buffer) == 24
    assert not any(torch.equal(weights(model), before) for model in models)
