"""The learner beside AFM: what actions can undo is not its business."""

import copy
from functools import partial

import pytest
import torch
from harness import HIGH
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    ResetAdam,
    StreamXUpdater,
    UnmatchedUpdater,
)
from afm_rl.learning.error_decomposition import decompose_error

GRADIENT = partial(OnlineUpdater, optimizer=partial(ResetAdam, lr=1e-3))


def learner(model, updater=GRADIENT, gate=2.0):  # the small model is a rough one
    model = copy.deepcopy(model).expand_(8)
    return UnmatchedUpdater(GaussianNLLLoss(model), updater, HIGH, gate=gate)


def transitions(gain, push=0.0):
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(8, 3, generator=generator)
    action = (2 * torch.rand(8, 2, generator=generator) - 1) * HIGH
    after = Dubins()(state, action * gain)
    side = torch.stack([-state[:, 2].sin(), state[:, 2].cos(), torch.zeros(8)], -1)
    td = TensorDict({"observation": state, "action": action}, [8])
    return td.set(("next", "observation"), after + push * side)


def rest(updater, td):
    """Return what no action explains, in standard deviations: the mean of missions."""
    rows = td["observation"], td["action"], td["next", "observation"]
    parts = decompose_error(updater.loss.model, *rows, HIGH)
    return parts.unmatched.abs().amax(-1).mean().item()


def weights(updater):
    return torch.cat([part.detach().flatten(1) for part in updater.loss.model.parameters()], 1)


def test_what_an_action_can_undo_is_not_learnt(trained_ensemble):
    updater = learner(trained_ensemble)
    before = weights(updater)
    losses = [updater(transitions(-1.0))["loss"] for _ in range(5)]
    assert torch.equal(weights(updater), before)
    assert bool((losses[0] == losses[-1]).all())
    healthy = learner(trained_ensemble)(transitions(1.0))["loss"]
    assert bool((losses[0] > healthy).all())  # but it is seen


@pytest.mark.parametrize(
    "updater", [GRADIENT, partial(StreamXUpdater, lr=0.1)], ids=["gradient", "stream_x"]
)
def test_what_no_action_can_undo_is_learnt(trained_ensemble, updater):
    learning = learner(trained_ensemble, updater)
    pushed = transitions(-1.0, push=0.3)
    before = rest(learning, pushed)
    for _ in range(30):
        learning(pushed)
    assert rest(learning, pushed) < before / 2


def test_missions_without_such_an_error_stay_as_they_are(trained_ensemble):
    updater = learner(trained_ensemble)
    before = weights(updater)
    pushed, plain = transitions(1.0, push=0.3), transitions(1.0)
    half = TensorDict.cat([pushed[:4], plain[4:]])
    updater(half)
    changed = (weights(updater) != before).any(1)
    assert changed.tolist() == [True] * 4 + [False] * 4
