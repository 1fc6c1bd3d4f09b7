"""The memory of the action flow transform: held for the newest step, or carried along."""

import functools
import warnings

import pytest
import torch
from puck import Puck, push
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import (
    Compose,
    GymWrapper,
    ParallelEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.envs import UGVTrack
from afm_rl.regimes import Schedule
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform

HYPOTHESES = ["recent", "newest", "delay_1"]


@pytest.fixture
def make(small_flow):
    """Make an environment with a reversed drive, which the flow does correct somehow."""

    def build(batch=(4,), max_steps=100, carry_memory=True, **settings):
        # From one point: among samples that are as good, rounding would decide.
        flow = small_flow(hypotheses=HYPOTHESES, source_std=0.0)
        base = UGVTrack(
            batch_size=batch,
            max_steps=max_steps,
            process_noise=0.0,
            schedule=Schedule([]),
            missions={"regime": {"v_gain": -1.0}},
        )
        settings["carry_memory"] = carry_memory
        return TransformedEnv(base, ActionFlowTransform(Dubins(), flow, **settings))

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
    assert entries.pop("enabled").all()
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
    flow, base = small_flow(hypotheses=HYPOTHESES), UGVTrack(batch_size=[4])
    transform = ActionFlowTransform(Dubins(), flow, reported_key="given", carry_memory=True)
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


def parallel(count, makers):
    return ParallelEnv(count, makers, mp_start_method="fork")


KINDS = {
    "around a series": (SerialEnv, False),
    "in a series": (SerialEnv, True),
    "around processes": (parallel, False),
    "in processes": (parallel, True),
}
ENDS, STEPS = (5, 7), 24


def reversed_pucks(kind="around a series", **settings):
    """Two environments with reversed actuators, whose episodes have 5 and 7 steps."""
    whole, inside = KINDS[kind]

    def corrected(env):
        model = KnownDynamics(push, Manifold(4), 2)
        return TransformedEnv(env, ActionFlowTransform(model, **settings))

    def make(ends):
        env = GymWrapper(Puck(gain=-1.0, ends=ends))
        return corrected(env) if inside else env

    env = whole(2, [lambda ends=ends: make(ends) for ends in ENDS])
    env = env if inside else corrected(env)
    env.set_seed(0)
    return env


def act(env, resets=()):
    """Return what is executed for random plans; the environment begins anew before ``resets``."""
    plans = torch.rand(STEPS, 2, 2, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    td, steps = env.reset(), []
    for k, plan in enumerate(plans):
        td = env.reset() if k in resets else td
        whole, td = env.step_and_maybe_reset(td.set("action", plan))
        steps.append(whole["next", "afm"].exclude("memory"))
    return torch.stack(steps)


@functools.cache
def carried(keep):
    return act(reversed_pucks(carry_memory=True, keep_memory_on_reset=keep), [17])


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_held_and_carried_memories_are_the_same_also_where_resets_keep_them(kind, keep):
    """In each mission by itself, and a bare reset is one of all."""
    expected, env = carried(keep), reversed_pucks(kind, keep_memory_on_reset=keep)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            found = act(env, [17])
    finally:
        env.close(raise_if_closed=False)
    rounding = {"rtol": 0, "atol": 1e-5}  # of missions in one batch or alone
    torch.testing.assert_close(found["executed_action"], expected["executed_action"], **rounding)
    assert found["misaligned"][4:].all() if keep else found["misaligned"].double().mean() < 0.7


def test_after_a_rollout_the_next_goes_on_from_its_end():
    executed = []
    for carry in (False, True):
        env = reversed_pucks(carry_memory=carry)
        torch.manual_seed(0)
        td = step_mdp(env.rollout(4)[:, -1])
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            data = env.rollout(6, tensordict=td, auto_reset=False, break_when_any_done=False)
        executed.append(data["next", "afm", "executed_action"])
    torch.testing.assert_close(*executed)


def test_of_another_step_nothing_is_held_which_is_said(make):
    env, action = make(carry_memory=False), torch.full((4, 2), 0.5)
    td, executed = follow(env, env.reset(), action.expand(8, 4, 2))
    fork, rows = td.clone(), torch.tensor([True, False, True, False])
    assert td["afm", "misaligned"].all()
    td, _ = follow(env, td, action[None])
    mixed = torch.where(rows, td, fork)  # of the second and the last the step before
    with pytest.warns(UserWarning, match="goes on with an empty one.* carry_memory=True"):
        found = env.step(mixed.set("action", action))["next", "afm"]
    assert torch.equal(found["misaligned"], rows)
    assert torch.equal(found["executed_action"][~rows], action[~rows])
    with pytest.warns(UserWarning, match="goes on with an empty one"):
        make(carry_memory=False).step(fork.set("action", action))  # another environment


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
