"""What TorchRL asks of every transform and primer of ours, in this version and in the next."""

import copy
import pickle
import warnings

import pytest
import torch
from harness import HIGH, LOW
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, SerialEnv, StepCounter, Transform
from torchrl.envs import TransformedEnv as Transformed
from torchrl.envs.utils import check_env_specs

from afm_rl.correction import ActionFlow, PaperFlow
from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain, Delay
from afm_rl.regimes import Compose as Regimes
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, Guard, RegimeTransform

LATE = Regimes({"delay": Delay(), "gain": ActionGain(["v", "omega"])})


def correction(observation_key="observation", action_key="action", flow=None, **settings):
    flow = flow or ActionFlow(LOW, HIGH)
    return ActionFlowTransform(Dubins(), flow, [observation_key], [action_key], **settings)


def published(**settings):
    flow = PaperFlow(LOW, HIGH, features=[2], state_size=3, width=8, gate=0.0)
    return correction(flow=flow, **settings)


def regime(prefix="change", **settings):
    phases = [{}, {"delay": 1.0, "v": -1.0}]
    return RegimeTransform(LATE, phases, at=[1], prefix=prefix, **settings)


def planner():
    return MPPI(PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH), candidates=8)


TRANSFORMS = {
    "guard": Guard,
    "regime": regime,
    "correction": correction,
    "with a belief": lambda **keys: correction(belief=True, **keys),
    "published": published,
}
PRIMERS = {
    "planner": lambda: planner().make_tensordict_primer(),
    "policy": lambda: ActionFlowPolicy(Dubins(), planner().action_spec).make_tensordict_primer(),
}
OURS = TRANSFORMS | PRIMERS


def each(makers):
    return pytest.mark.parametrize("make", makers.values(), ids=makers)


def track(batch=()):
    ends = {"action_low": LOW.tolist(), "action_high": HIGH.tolist()}
    return UGVTrack(batch_size=batch, max_steps=3, **ends)


BASES = {
    "alone": track,
    "batch": lambda: track((2, 3)),
    "series": lambda: SerialEnv(2, track),
    "batches in a series": lambda: SerialEnv(2, lambda: track((3,))),
    "planning": lambda: PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH),
}


ON_BASES = {
    **{name: (make, BASES["batches in a series"]) for name, make in OURS.items()},
    **{f"correction, {name}": (correction, make) for name, make in BASES.items()},
}


@pytest.mark.parametrize(("make", "base"), ON_BASES.values(), ids=ON_BASES)
def test_specs_hold_and_may_be_locked_and_those_of_the_parent_stay(make, base):
    env = base()
    before = env.output_spec.clone(), env.input_spec.clone()
    whole = Transformed(env, Compose(make())).set_spec_lock_()
    assert whole.is_spec_locked and env.is_spec_locked
    check_env_specs(whole, break_when_any_done="both")
    assert (env.output_spec, env.input_spec) == before


@each(OURS)
def test_inside_a_series(make):
    whole = SerialEnv(2, lambda: Transformed(track(), Compose(make())))
    check_env_specs(whole, break_when_any_done="both")


@each(TRANSFORMS)
def test_keys_may_be_nested_and_come_from_yaml(make):
    keys = {"observation_key": ["robot", "pose"], "action_key": ["robot", "action"]}
    cost = GoalDistance(in_keys=[["task", "goal"]])
    world = PlanningEnv(Dubins(), cost, LOW, HIGH, *keys.values())
    chain = make(prefix=["robot", "ours"], **keys)
    env = Transformed(world, chain)
    check_env_specs(env)
    assert ("robot", "ours") in env.rollout(2)["next"].keys(True)
    assert chain.key("memory") == ("robot", "ours", "memory")


@each(TRANSFORMS)
def test_without_an_environment_nothing_is_done(make):
    td = TensorDict({"observation": torch.randn(5, 3), "action": torch.randn(5, 2)}, [5])
    for chain in (make(), Compose(make(), make(prefix="b"))):
        assert (chain(td.clone()) == td).all() and (chain.inv(td.clone()) == td).all()
    storage = LazyTensorStorage(5)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=5, transform=make())
    buffer.extend(td)
    drawn = buffer.sample()["action"].unsqueeze(1) == td["action"]
    assert drawn.all(-1).any(-1).all()


@each(TRANSFORMS)
@pytest.mark.parametrize("others", [(), (StepCounter,)], ids=["alone", "in company"])
def test_a_tensordict_without_its_entries_is_refused_clearly(make, others):
    env = Transformed(track(), Compose(make(prefix=["my", "own"]), *(other() for other in others)))
    td = env.reset().exclude("my").set("action", torch.zeros(2))
    with pytest.raises(KeyError, match=r"no \('my', 'own'\) in the tensordict; start from env.r"):
        env.step(td)


@each(TRANSFORMS)
def test_copies_behave_alike(make):
    data, original = [], make()
    whole = Transformed(track((2,)), original)
    twins = [copy.deepcopy(original), pickle.loads(pickle.dumps(original))]
    for env in (whole, *(Transformed(track((2,)), twin) for twin in twins)):
        torch.manual_seed(0)
        data.append(env.rollout(3))
        torch.testing.assert_close(data[-1], data[0])
    twins.append(copy.deepcopy(whole).transform)
    for twin in twins if isinstance(original, ActionFlowTransform) else []:
        assert twin.corrector is not original.corrector and twin.model is not original.model


@each(TRANSFORMS)
def test_actions_that_are_no_vectors_of_real_numbers_are_refused(make):
    with pytest.raises(ConfigurationError, match="of real numbers"):
        Transformed(GymEnv("CartPole-v1"), make()).reset()


@each(OURS)
def test_a_reset_begins_memories_anew_whether_it_sets_the_state_or_not(make):
    """So that the default does not matter; resets of ours that set none say nothing of it."""
    env = Transformed(track((2,)), Compose(make()))
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


@each(OURS)
def test_no_inverse_transform_writes_entries_of_the_next_step_and_others_pass(make):
    """So that it does not matter which of them TorchRL passes on; a policy's own arrive."""
    env = Transformed(track((2,)), Compose(make()))
    td = env.rand_action(env.reset())
    assert "next" not in env.transform.inv(td.clone()).keys()
    given = torch.rand(2, 3)
    assert torch.equal(env.step(td.set(("next", "mine"), given))["next", "mine"], given)
    with_notes = Transformed(track((2,)), Compose(make(), Notes()))
    later = with_notes.step(with_notes.rand_action(with_notes.reset()))["next"]
    assert {*later.keys()} - {"noted"} == {*env.step(td.exclude("next"))["next"].keys()}
