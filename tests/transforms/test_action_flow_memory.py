"""The memory of the action flow transform, which it holds for the newest step."""

import warnings

import gymnasium
import pytest
import torch
from harness import HIGH, LOW
from puck import Puck, push
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import Bounded, Unbounded
from torchrl.envs import Compose, GymWrapper, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins, KnownDynamics, MuJoCoDynamics
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Schedule
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, CorrectionLoop

REVERSED = {"schedule": Schedule([]), "missions": {"regime": {"v_gain": -1.0}}}


def make(base=None):
    """Correct environments with a reversed drive; by default four, as one batch."""
    base = UGVTrack(batch_size=(4,), process_noise=0.0, **REVERSED) if base is None else base
    return TransformedEnv(base, ActionFlowTransform(Dubins()))


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


def test_nothing_is_learnt_from_a_step_in_which_others_moved_the_robot():
    spec = Bounded(LOW, HIGH)
    loop = CorrectionLoop("loop").complete(Dubins(), spec)
    state = torch.zeros(3)
    memory, _ = loop.begin(state, spec)
    for k in range(24):
        memory, step = loop.act(memory, torch.tensor([0.4, 0.3]), spec)
        assert not step.corrected and torch.equal(step.executed_action, step.planned_action)
        moved = 8 <= k < 18
        state = Dubins()(state, -step.executed_action if moved else step.executed_action)
        memory = loop.observe(memory, state)
        if moved:
            memory, _ = loop.begin(state, spec, memory)


def test_entries_are_empty_at_the_start_but_for_state_and_box():
    env = make()
    td = env.reset()
    entries, space = td["afm"].clone(), env.full_action_spec["action"].space
    bounds = torch.stack([space.low, space.high], -2)
    torch.testing.assert_close(entries.pop("effect_bounds"), bounds)
    for seen in ("observation", "arrival"):
        assert torch.equal(entries.pop(seen), td["observation"])
    assert entries.pop("enabled").all()
    assert not any(part.any() for part in entries.values())


class Reports(Transform):
    """Actuators that gave other actions than they were sent, and say so."""

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("given", torch.full_like(tensordict["action"], 0.3))

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset.set("given", torch.zeros(*tensordict_reset.batch_size, 2))

    def transform_observation_spec(self, observation_spec):
        observation_spec["given"] = Unbounded((*observation_spec.shape, 2))
        return observation_spec


def test_it_remembers_what_actuators_report(flow):
    base = UGVTrack(batch_size=[4])
    transform = ActionFlowTransform(Dubins(), flow, reported_key="given")
    env = TransformedEnv(base, Compose(Reports(), transform))
    now = env.step(env.reset().set("action", torch.full((4, 2), 0.5)))["next"]
    torch.testing.assert_close(transform.memory["actions"][:, -1], torch.full((4, 2), 0.3))
    assert torch.equal(now["afm", "executed_action"], torch.full((4, 2), 0.5))


def by_state_dict(old, new, path):
    torch.save(old.state_dict(), path)
    new.load_state_dict(torch.load(path, weights_only=True))


def by_checkpoint(old, new, path):
    Checkpoint(env=old).save(path.with_suffix(".zip"), format="archive")
    Checkpoint(env=new).load(path.with_suffix(".zip"))


@pytest.mark.parametrize("move", [by_state_dict, by_checkpoint])
@pytest.mark.parametrize("cut", [1, 2, 5])
def test_a_rollout_resumes_exactly_in_another_environment(move, cut, tmp_path):
    actions = torch.rand(8, 4, 2)
    env = make()
    whole, executed = follow(env, env.reset(), actions)
    first, second = make(), make()
    middle, _ = follow(first, first.reset(), actions[:cut])
    move(first, second, tmp_path / "state")
    end, resumed = follow(second, middle.clone(), actions[cut:])
    assert torch.equal(resumed, executed[cut:]) and same(end, whole)
    for name, field in env.transform.memory.items():
        assert torch.equal(second.transform.memory[name], field)


def parallel(count, makers, **settings):
    return ParallelEnv(count, makers, mp_start_method="fork", **settings)


KINDS = {
    "around a series": (SerialEnv, False),
    "in a series": (SerialEnv, True),
    "around processes": (parallel, False),
    "in processes": (parallel, True),
}
EACH = [pytest.param(kind, marks=pytest.mark.slow if "processes" in kind else []) for kind in KINDS]


def several(kind, makers, correct, **settings):
    """Environments side by side, corrected one by one or together."""
    whole, inside = KINDS[kind]
    if inside:
        makers = [lambda make=make: correct(make()) for make in makers]
        return whole(len(makers), makers, **settings)
    return correct(whole(len(makers), makers, **settings))


@pytest.mark.parametrize("kind", EACH)
def test_a_state_dict_goes_back_to_its_step(kind):
    """In each environment separately, and later steps leave no trace."""
    tracks = [lambda: UGVTrack(process_noise=0.0, **REVERSED)] * 2
    # With buffers, TorchRL 0.14.1 does not wait for the step after a load in its workers.
    env = several(kind, tracks, make, use_buffers=False, consolidate=False)
    actions = torch.rand(9, 2, 2)
    try:
        fork, state = follow(env, env.reset(), actions[:4])[0].clone(), env.state_dict()
        runs = []
        for plans in (actions[4:], -actions[4:], actions[4:]):
            env.load_state_dict(state)
            runs.append([part.clone() for part in follow(env, fork.clone(), plans)])
    finally:
        env.close(raise_if_closed=False)
    (first, expected), _, (again, executed) = runs
    assert torch.equal(executed, expected) and same(first, again)
    assert first["afm", "corrected"].all()


def test_commands_of_the_last_episode_do_not_act_in_the_next_one():
    spec, late = Bounded(LOW, HIGH), 3
    loop = CorrectionLoop("loop").complete(Dubins(), spec)
    state = torch.zeros(3)
    memory, _ = loop.begin(state, spec)
    commands = [torch.zeros(2)] * late
    for k in range(30):
        planned = torch.tensor([0.8, 0.9]) * torch.tensor([1.1 * k, 0.7 * k]).sin()
        memory, step = loop.act(memory, planned, spec)
        commands.append(step.executed_action)
        state = Dubins()(state, commands[-1 - late])
        memory = loop.observe(memory, state)
    memory, _ = loop.begin(torch.zeros(3), spec, memory)
    assert loop.delay_in(memory) == late
    memory, step = loop.act(memory, torch.tensor([0.5, 0.2]), spec)
    *before, newest = loop.corrector.under_way(memory)
    assert not torch.stack(before).any() and newest.any()


def test_a_state_dict_of_an_older_version_is_refused_and_changes_nothing():
    env = make(UGVTrack(process_noise=0.0))
    env.rollout(3)
    transform = env.transform
    state = transform.state_dict()
    with pytest.raises(ConfigurationError, match="of version 0.3, whose memory cannot"):
        transform.load_state_dict({**state, "_extra_state": torch.zeros(9)})
    assert torch.equal(transform.memory["state"], state["memory.state"])


PUCK = KnownDynamics(push, Manifold(4), 2)


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("kind", EACH)
def test_each_mission_has_a_memory_that_its_own_resets_empty_unless_they_keep_it(kind, keep):
    """As the loop has it of each alone; and a bare reset is one of all."""

    def correct(env):
        return TransformedEnv(env, ActionFlowTransform(PUCK, keep_memory_on_reset=keep))

    makers = [lambda ends=ends: GymWrapper(Puck(gain=-1.0, ends=ends)) for ends in (5, 7)]
    env = several(kind, makers, correct)
    env.set_seed(0)
    plans = torch.rand(24, 2, 2, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    td, steps, spec = env.reset(), [], Bounded(-torch.ones(2), torch.ones(2), dtype=torch.double)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            for k, plan in enumerate(plans):
                td = env.reset() if k == 17 else td
                step, td = env.step_and_maybe_reset(td.set("action", plan))
                steps.append(step.clone())
    finally:
        env.close(raise_if_closed=False)
    data, loop = torch.stack(steps), CorrectionLoop("loop", PUCK).complete(action_spec=spec)
    begins = torch.cat([torch.ones(1, 2, dtype=torch.bool), data["next", "done"][:-1, :, 0]])
    begins[17] = True
    for mission in (0, 1):
        memory = None
        for step, begin in zip(data[:, mission], begins[:, mission], strict=True):
            if begin:
                learnt = memory if keep else None
                memory, _ = loop.begin(step["observation"], spec, learnt)
            (memory, record), found = loop.act(memory, step["action"], spec), step["next", "afm"]
            for name in ("executed_action", "innovation"):  # one batch rounds differently
                torch.testing.assert_close(found[name], getattr(record, name), rtol=1e-4, atol=1e-5)
            assert found["corrected"] == record.corrected
            memory = loop.observe(memory, step["next", "observation"])
    corrected = data["next", "afm", "corrected"]
    assert corrected[4:].all() if keep else not corrected[begins].any()


def test_of_another_step_nothing_is_held_which_is_said():
    env, action = make(), torch.full((4, 2), 0.5)
    td, executed = follow(env, env.reset(), action.expand(8, 4, 2))
    fork, rows = td.clone(), torch.tensor([True, False, True, False])
    assert td["afm", "corrected"].all()
    td, _ = follow(env, td, action[None])
    mixed = torch.where(rows, td, fork)  # of the second and the last the step before
    with pytest.warns(
        UserWarning, match=r"restarts with an empty memory.* load the state_dict\(\)"
    ):
        found = env.step(mixed.set("action", action))["next", "afm"]
    assert torch.equal(found["corrected"], rows)
    assert torch.equal(found["executed_action"][~rows], action[~rows])
    with pytest.warns(UserWarning, match="restarts with an empty memory"):
        make().step(fork.set("action", action))  # another environment


@pytest.mark.parametrize("end", ["transform", "policy"])
def test_whoever_forgets_to_go_on_is_warned(flow, end):
    if end == "transform":
        env = make()
        td, step = env.reset().set("action", torch.full((4, 2), 0.5)), env.step
    else:
        spec = make().action_spec_unbatched
        step = ActionFlowPolicy(Dubins(), spec, flow)
        td = step.make_tensordict_primer()(TensorDict())
        td.update({"observation": torch.zeros(3), "action": torch.zeros(2)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        td = step(td)
        going = step(step_mdp(td.clone(), exclude_action=False))
    assert "afm" in going["next"].keys()
    with pytest.warns(UserWarning, match="continue with step_mdp"):
        step(td)


@pytest.mark.check
def test_interleaved_missions_have_the_commands_of_each_alone():
    """Also of a model whose derivatives are kept: they belong to the memory."""
    model = MuJoCoDynamics(gymnasium.make("Humanoid-v5"))
    assert model.keeps_derivative
    low, high = model.action_low.double(), model.action_high.double()
    spec = Bounded(low, high, low.shape, dtype=low.dtype)
    loop = CorrectionLoop("test", model).complete(action_spec=spec)

    def mission(seed, steps=12):
        """Drive a robot whose motors are reversed; yield the commands."""
        draws = torch.Generator().manual_seed(seed)
        state = torch.zeros(model.state_size).double()
        state[2], state[3] = 1.4, 1.0
        memory, _ = loop.begin(state, spec)
        for _ in range(steps):
            plan = 0.3 * (2 * torch.rand(low.shape, generator=draws).double() - 1)
            memory, step = loop.act(memory, plan, spec)
            yield step.executed_action
            state = model(state, -step.executed_action)
            memory = loop.observe(memory, state)

    alone = [torch.stack([*mission(seed)]) for seed in (0, 1)]
    pairs = zip(mission(0), mission(1), strict=True)
    together = [torch.stack(commands) for commands in zip(*pairs, strict=True)]
    assert all(map(torch.equal, alone, together))
    assert (alone[0][-1] != 0).any()
