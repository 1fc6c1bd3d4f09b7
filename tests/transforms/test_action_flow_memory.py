"""The memory of the action flow transform lives in the tensordict."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, SerialEnv, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.regimes import Schedule
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform

READINGS = ["recent", "newest", "delay_1"]


@pytest.fixture
def make(small_flow):
    """Make an environment with a reversed drive, which the flow does correct somehow."""

    def build(batch=(4,), max_steps=100):
        # From one point: among samples that are as good, rounding would decide.
        flow = small_flow(readings=READINGS, source_std=0.0)
        base = UGVTrack(
            batch_size=batch,
            max_steps=max_steps,
            process_noise=0.0,
            schedule=Schedule([]),
            missions={"regime": {"v_gain": -1.0}},
        )
        return TransformedEnv(base, ActionFlowTransform(Dubins(), flow))

    return build


def follow(env, td, actions):
    """Step through given actions ``(T, *B, 2)``; return the last and all executed actions."""
    executed = []
    for action in actions:
        td["action"] = action
        td = env.step(td)
        executed.append(td["next", "afm", "executed_action"])
        td = step_mdp(td)
    return td, torch.stack(executed)


def same(left, right):
    return all((left.get(key) == right.get(key)).all() for key in left.keys(True, True))


def test_it_is_empty_at_the_start_but_for_state_and_box(make):
    env = make()
    td = env.reset()
    entries = td["afm"].clone()
    memory = entries.pop("memory")
    torch.testing.assert_close(memory[:, :3], td["observation"])
    space = env.full_action_spec["action"].space
    bounds = torch.stack([space.low, space.high], -2)
    torch.testing.assert_close(entries.pop("effect_bounds"), bounds)
    for seen in ("observation", "arrival"):
        assert torch.equal(entries.pop(seen), td["observation"])
    begun = env.transform.corrector.begin(td["observation"])
    assert torch.equal(memory, begun) and not any(part.any() for part in entries.values())


def test_it_holds_the_latest_transitions_oldest_first(make, remembered):
    env, steps = make(), 15
    data, corrector = env.rollout(steps), env.transform.corrector
    found = remembered(corrector, data["next", "afm"])
    for step in (0, 4, steps - 1):
        held = min(step + 1, corrector.recent)
        now = {name: part[:, step] for name, part in found.items()}
        assert (now["valid"].sum(-1) == held).all() and now["valid"][:, -held:].all()
        past = data[:, step + 1 - held : step + 1]
        torch.testing.assert_close(now["state"][:, -held:], past["observation"])
        torch.testing.assert_close(now["next_state"][:, -held:], past["next", "observation"])
        torch.testing.assert_close(now["planned"][:, -held:], past["action"])
        executed = past["next", "afm", "executed_action"]
        torch.testing.assert_close(now["executed"][:, -held:], executed)


class Reports(Transform):
    """Actuators that gave other actions than they were sent, and say so."""

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("given", torch.full_like(tensordict["action"], 0.3))

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset.set("given", torch.zeros(*tensordict_reset.batch_size, 2))

    def transform_observation_spec(self, observation_spec):
        observation_spec["given"] = Unbounded((*observation_spec.shape, 2))
        return observation_spec


def test_it_remembers_what_actuators_report(small_flow, remembered):
    """And forecasts of what was sent count as forecasts of what was given."""
    flow, base = small_flow(readings=READINGS), UGVTrack(batch_size=[4])
    transform = ActionFlowTransform(Dubins(), flow, reported_key="given")
    env = TransformedEnv(base, Compose(Reports(), transform))
    td = env.reset()
    td["action"] = torch.full((4, 2), 0.5)
    now = env.step(td)["next"]
    held = remembered(flow, now["afm"])["executed"][:, -1]
    torch.testing.assert_close(held, torch.full((4, 2), 0.3))
    assert torch.equal(now["afm", "executed_action"], torch.full((4, 2), 0.5))

    sent = flow.executing(td["afm", "memory"], td["action"], td["action"])
    moved = flow.unpack(flow.reported(sent, held), 3)["forecasts"]
    more = flow.normalise(held - td["action"]).unsqueeze(-2)
    before = flow.unpack(sent, 3)["forecasts"]
    torch.testing.assert_close(moved - before, more.expand_as(moved))


def test_one_surprise_is_not_answered(make):
    env, action = make(), torch.full((4, 2), 0.5)
    td, executed = follow(env, env.reset(), action.expand(2, 4, 2))
    assert not td["afm", "misaligned"].any() and torch.equal(executed[1], action)


def test_a_partial_reset_clears_its_own_rows_only(make):
    env = make()
    td, _ = follow(env, env.reset(), torch.full((4, 4, 2), 0.5))
    before = td["afm"].clone()
    rows = torch.tensor([True, False, False, True])
    td["_reset"] = rows.unsqueeze(-1)
    after = env.reset(td, set_state=False)
    assert same(after["afm"][~rows], before[~rows])
    fresh = after["afm"][rows]
    torch.testing.assert_close(fresh["memory"][:, :3], after["observation"][rows])
    begun = env.transform.corrector.begin(after["observation"][rows])
    assert torch.equal(fresh["memory"], begun) and not fresh["innovation"].any()


@pytest.mark.parametrize("cut", [1, 2, 5])
def test_a_rollout_resumes_exactly_in_another_environment(make, cut):
    actions = torch.rand(8, 4, 2)
    env = make()
    whole, executed = follow(env, env.reset(), actions)
    first = make()
    middle, _ = follow(first, first.reset(), actions[:cut])
    kept = TensorDict({key: value.clone() for key, value in middle.items()}, [4])
    end, resumed = follow(make(), kept, actions[cut:])
    assert torch.equal(resumed, executed[cut:]) and same(end, whole)


def test_branches_from_one_state_are_independent(make):
    env, actions = make(), torch.rand(5, 4, 2)
    fork, _ = follow(env, env.reset(), actions[:2])
    saved = fork.clone()
    first, _ = follow(env, fork.clone(), actions[2:])
    follow(env, fork.clone(), -actions[2:])  # elsewhere in the meantime
    again, _ = follow(env, fork.clone(), actions[2:])
    assert same(first, again) and same(fork, saved)


def test_environments_in_series_obey_the_tensordict_given(make):
    series, actions = SerialEnv(2, lambda: make(batch=())), torch.rand(5, 2, 2)
    fork, _ = follow(series, series.reset(), actions[:2])
    fork = fork.clone()
    first, expected = follow(series, fork.clone(), actions[2:])
    again, executed = follow(series, fork.clone(), actions[2:])
    assert torch.equal(executed, expected)


@pytest.mark.parametrize("more", [[], [StepCounter()]], ids=["alone", "in company"])
def test_a_tensordict_without_memory_is_refused_clearly(small_flow, more):
    chain = Compose(ActionFlowTransform(Dubins(), small_flow(), prefix=["my", "afm"]), *more)
    env = TransformedEnv(UGVTrack(), chain)
    td = env.reset().exclude("my")
    with pytest.raises(KeyError, match=r"no \('my', 'afm'\) in the tensordict; start from env.r"):
        env.step(td.set("action", torch.zeros(2)))


@pytest.mark.parametrize("end", ["transform", "policy"])
def test_whoever_forgets_to_go_on_is_warned(make, small_flow, end):
    if end == "transform":
        env = make()
        td, step = env.reset().set("action", torch.full((4, 2), 0.5)), env.step
    else:
        spec = make().action_spec_unbatched
        step = ActionFlowPolicy(Dubins(), spec, small_flow())
        td = step.make_tensordict_primer()(TensorDict())
        td.update({"observation": torch.zeros(3), "action": torch.zeros(2)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        td = step(td)
        going = step(step_mdp(td.clone(), exclude_action=False))
    assert "afm" in going["next"].keys()
    with pytest.warns(UserWarning, match="go on with step_mdp"):
        step(td)
