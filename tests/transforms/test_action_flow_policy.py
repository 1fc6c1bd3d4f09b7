"""The action flow as the end of a policy: the same actions as the transform's."""

import copy

import pytest
import torch
from harness import HIGH, LOW
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, TransformedEnv

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform

STEPS = 8
BACKWARDS = {"schedule": Schedule([]), "missions": {"regime": {"v_gain": -2.5}}}


def track(**settings):
    """Make a robot that goes backwards, and faster than planned."""
    ends = {"action_low": LOW.tolist(), "action_high": HIGH.tolist()}
    return UGVTrack(**ends, **BACKWARDS, **settings)


@pytest.fixture
def planner(box):
    """Make a planner that knows how far actions reach."""
    world = PlanningEnv(Dubins(), GoalDistance(), *box)
    return MPPI(world, horizon=3, candidates=20, bounds_key=["afm", "effect_bounds"])


@pytest.fixture
def agent(planner, flow):
    """Planner and correction as one policy."""
    return TensorDictSequential(planner, ActionFlowPolicy(Dubins(), planner.action_spec, flow))


def primers(agent):
    return Compose(*(part.make_tensordict_primer() for part in agent))


def test_actions_are_those_of_the_transform(agent, flow):
    planner, policy = copy.deepcopy(agent)
    chain = Compose(ActionFlowTransform(Dubins(), flow), planner.make_tensordict_primer())
    one, other = (track(batch_size=(3,), process_noise=0.0) for _ in range(2))
    expected = TransformedEnv(one, chain).rollout(STEPS, planner)
    found = TransformedEnv(other, primers(agent)).rollout(STEPS, agent)
    assert expected["next", "afm", "corrected"].any()
    assert torch.equal(found["action"], expected["next", "afm", "executed_action"])
    for name in ("planned_action", "innovation", "noise", "effect_bounds"):
        assert torch.equal(found["next", "afm", name], expected["next", "afm", name])


def test_keys_are_declared_and_may_be_nested(planner, flow):
    policy = ActionFlowPolicy(
        Dubins(),
        planner.action_spec,
        flow,
        ["robot", "pose"],
        ["robot", "action"],
        ["robot", "afm"],
    )
    given = {"pose": torch.zeros(3), "action": torch.ones(2)}
    td = policy.make_tensordict_primer()(TensorDict({"robot": given}))
    out = policy(td.select(*policy.in_keys))
    assert set(policy.out_keys) <= set(out.keys(True, True))
    assert torch.equal(out["next", "robot", "afm", "planned_action"], torch.ones(2))


def test_without_its_memory_it_says_what_is_missing(agent):
    td = TensorDict({"observation": torch.zeros(3), "action": torch.zeros(2)})
    with pytest.raises(KeyError, match="no 'afm' in the tensordict; apply make_tensordict_primer"):
        agent[1](td)


def test_a_primer_keeps_what_was_learnt_through_automatic_resets(planner):
    base, shares = track(max_steps=5), []
    for keep in (False, True):
        policy = ActionFlowPolicy(Dubins(), planner.action_spec, keep_memory_on_reset=keep)
        agent = TensorDictSequential(planner, policy)
        env = TransformedEnv(base, primers(agent))
        data = env.rollout(40, agent, break_when_any_done=False)
        shares.append(data["next", "afm", "corrected"].double().mean())
    assert shares[0] < 0.7 and shares[1] >= 0.9
