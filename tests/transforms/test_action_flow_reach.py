"""What the action flow transform tells planners of what can be had."""

import math

import pytest
import torch
from torchrl.envs import TransformedEnv

from afm_rl.dynamics import Calibrated, Dubins, Oracle
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.flow import Context, Correction, Corrector
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain
from afm_rl.transforms import ActionFlowTransform

LOW, HIGH = torch.tensor([-1.0, -math.pi / 2]), torch.tensor([1.0, math.pi / 2])


class Stub(Corrector):
    """Opens the gate once it has seen a transition, corrects nothing, and tells a reach."""

    feature_size = 1

    def __init__(self, reach, bad=()):
        super().__init__(LOW, HIGH, gate=0.0, window=2)
        self.reach, self.bad = reach, bad

    def context(self, window, model, last):
        size = window.valid.sum(-1).to(window.state)
        none = size.unsqueeze(-1)[..., :0]
        pairs = none.unsqueeze(-2).expand(*window.valid.shape, 0)
        return Context(pairs, none, size.unsqueeze(-1), size, size > 0)

    def correct(self, context, state, planned):
        reach = None if self.reach is None else self.reach.expand(*planned.shape[:-1], 2, 2)
        action = planned.clone()
        for row in self.bad:
            action[row] = math.nan
        return Correction(action, torch.zeros_like(planned), reach)


def env(reach, batch=(4,), model=None, bad=(), **settings):
    base = UGVTrack(batch_size=batch, process_noise=0.0)
    chain = ActionFlowTransform(model or Dubins(), Stub(reach, bad), **settings)
    return TransformedEnv(base, chain)


BOX = torch.stack([LOW, HIGH])


@pytest.mark.parametrize(
    ("reach", "expected"),
    [
        (None, BOX),
        (0.5 * BOX, BOX),
        (2.5 * BOX, 2.5 * BOX),
        (torch.stack([2 * LOW, 0.1 * HIGH]), torch.stack([2 * LOW, HIGH])),
        (torch.full((2, 2), math.nan), BOX),
        (torch.full((2, 2), math.inf), BOX),
    ],
    ids=["none", "less", "more", "either", "nan", "inf"],
)
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_the_reach_is_never_less_than_the_box(reach, expected, batch):
    data = env(reach, batch=batch).rollout(3)
    found = data["next", "afm", "reach"].movedim(len(batch), 0)
    torch.testing.assert_close(
        data["afm", "reach"].movedim(len(batch), 0)[0], BOX.expand(*batch, 2, 2)
    )
    torch.testing.assert_close(found[0], BOX.expand(*batch, 2, 2))  # the gate is closed
    torch.testing.assert_close(found[1:], expected.expand(2, *batch, 2, 2))


def test_a_box_without_zero_stays_one():
    stub = Stub(BOX, bad=[...])
    base = PlanningEnv(Dubins(), GoalDistance(), 0.5 * HIGH, HIGH)
    data = TransformedEnv(base, ActionFlowTransform(Dubins(), stub)).rollout(3)
    expected = torch.stack([0.5 * HIGH, HIGH]).expand(3, 2, 2)
    torch.testing.assert_close(data["next", "afm", "reach"], expected)


def test_planners_hear_of_more_only_if_they_may_and_the_model_can_foresee_it(make_ensemble):
    known = {
        "widened": {},
        "not wished": {"extend_action_box": False},
        "switched off": {"enabled": False},
        "a network": {"model": make_ensemble()},
        "calibrated": {"model": Calibrated(Dubins(), HIGH)},
        "calibrated network": {"model": Calibrated(make_ensemble(), HIGH)},
        "oracle": {"model": Oracle(Dubins(), ActionGain(["v", "omega"]))},
    }
    for name, settings in known.items():
        data = env(2.5 * BOX, **settings).rollout(3)
        wider = name in ("widened", "calibrated", "oracle")
        expected = (2.5 if wider else 1.0) * BOX.expand(4, 2, 2)
        torch.testing.assert_close(data["next", "afm", "reach"][:, -1], expected, msg=name)
    with pytest.raises(ConfigurationError, match="transform.extend_action_box"):
        env(BOX, extend_action_box="yes")


def test_of_an_answer_that_is_not_finite_the_reach_is_not_believed_either():
    reach = env(3 * BOX, bad=[0, 2]).rollout(4)["next", "afm", "reach"]
    torch.testing.assert_close(reach[[0, 2]], BOX.expand(2, 4, 2, 2))
    torch.testing.assert_close(reach[[1, 3], 1:], 3 * BOX.expand(2, 3, 2, 2))
