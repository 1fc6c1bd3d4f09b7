"""What TorchRL changes after 0.14.1, as far as 0.14.1 can show it."""

import warnings

import pytest
import torch
from torchrl.envs import Compose, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain, Delay
from afm_rl.regimes import Compose as Regimes
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, Guard, RegimeTransform

LATE = Regimes({"delay": Delay(), "gain": ActionGain(["v", "omega"])})


def planner():
    return MPPI(PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5]), population=8)


OURS = {
    "guard": Guard,
    "regime": lambda: RegimeTransform(LATE, [{"delay": 1.0, "v": -1.0}], prefix="change"),
    "correction": lambda: ActionFlowTransform(Dubins(), delay=1, belief=True),
    "memory carried": lambda: ActionFlowTransform(Dubins(), carry_memory=True),
    "planner": lambda: planner().make_tensordict_primer(),
    "policy": lambda: ActionFlowPolicy(Dubins(), planner().action_spec).make_tensordict_primer(),
}


def track(**settings):
    box = {"action_low": [-1.0, -1.5], "action_high": [1.0, 1.5]}
    return UGVTrack(batch_size=(2,), max_steps=4, **box, **settings)


@pytest.mark.parametrize("base", [track, lambda: SerialEnv(2, track)], ids=["alone", "in a series"])
@pytest.mark.parametrize("make", OURS.values(), ids=OURS)
def test_specs_may_be_locked_and_those_of_the_parent_stay_as_they_are(make, base):
    env = base()
    before = env.output_spec.clone(), env.input_spec.clone()
    whole = TransformedEnv(env, Compose(make())).set_spec_lock_()
    assert whole.is_spec_locked and env.is_spec_locked
    check_env_specs(whole, break_when_any_done="both")
    assert (env.output_spec, env.input_spec) == before


@pytest.mark.parametrize("make", OURS.values(), ids=OURS)
def test_a_reset_begins_memories_anew_whether_it_sets_the_state_or_not(make):
    """So that the default does not matter; resets of ours that set none say nothing of it."""
    env = TransformedEnv(track(), Compose(make()))
    (prefix,) = {*env.reset().keys()} - {*track().reset().keys()}
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        warnings.simplefilter("error", FutureWarning)
        fresh = env.reset()[prefix]
        td = env.rollout(6, break_when_any_done=False)[:, 2].exclude("next")
        for is_state_set in (False, True):
            again = env.reset(td.clone(), set_state=is_state_set)[prefix]
            assert {*again.keys(True, True)} == {*fresh.keys(True, True)}
            for name in {"step", "repeats", "executed_action", "mean"} & {*fresh.keys()}:
                assert torch.equal(again[name], fresh[name])


class Notes(Transform):
    """An inverse transform that writes an entry of the next step."""

    def _inv_call(self, tensordict):
        return tensordict.set(("next", "noted"), tensordict["action"].clone())


@pytest.mark.parametrize("make", OURS.values(), ids=OURS)
def test_no_inverse_transform_writes_entries_of_the_next_step_and_others_pass(make):
    """So that it does not matter which of them TorchRL passes on; a policy's own arrive."""
    env = TransformedEnv(track(), Compose(make()))
    td = env.rand_action(env.reset())
    assert "next" not in env.transform.inv(td.clone()).keys()
    given = torch.rand(2, 3)
    assert torch.equal(env.step(td.set(("next", "mine"), given))["next", "mine"], given)
    with_notes = TransformedEnv(track(), Compose(make(), Notes()))
    later = with_notes.step(with_notes.rand_action(with_notes.reset()))["next"]
    assert {*later.keys()} - {"noted"} == {*env.step(td.exclude("next"))["next"].keys()}
