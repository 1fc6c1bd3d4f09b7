"""The action flow transform does what TorchRL asks of every transform."""

import pytest
import torch
from harness import HIGH, LOW
from torch.utils._pytree import tree_leaves, tree_map
from torchrl.checkpoint import Checkpoint
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from afm_rl.correction import ActionFlow, PaperFlow
from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, Guard


def transform(**settings):
    return ActionFlowTransform(Dubins(), ActionFlow(LOW, HIGH), **settings)


def track(**settings):
    return UGVTrack(max_steps=3, **settings)


def env(*more, **settings):
    return TransformedEnv(track(**settings), Compose(transform(), *more))


def primed():
    return ActionFlowPolicy(Dubins(), track().action_spec).make_tensordict_primer()


TAKEN = {
    "in a chain": lambda: env(transform()),
    "unwrapped": lambda: TransformedEnv(env(), transform(), auto_unwrap=True),
    "nested": lambda: TransformedEnv(env(), transform(), auto_unwrap=False),
    "around a series": lambda: TransformedEnv(SerialEnv(2, env), transform()),
    "policy": lambda: env(primed()),
    "guard": lambda: TransformedEnv(track(), Compose(Guard(), transform(prefix="guard"))),
}


@pytest.mark.parametrize("make", TAKEN.values(), ids=TAKEN)
def test_two_under_one_prefix_are_refused(make):
    with pytest.raises(ConfigurationError, match="prefix='(afm|guard)': taken, by"):
        make().rollout(2)


@pytest.mark.parametrize("shell", ["transform", "policy"])
def test_the_corrector_is_owned_and_the_model_is_shared(make_ensemble, shell):
    model, flow = make_ensemble().train(), PaperFlow(LOW, HIGH, [2], 3, width=8)
    if shell == "transform":
        owner = ActionFlowTransform(model, flow)
        TransformedEnv(track(), Compose(owner))
    else:
        owner = ActionFlowPolicy(model, track().action_spec, flow)
    assert owner.model is model and model.training  # composing switches what is owned to eval
    stored = {name.partition("corrector.")[2] for name in owner.state_dict()}
    assert stored == {*flow.state_dict()} != set()
    assert {id(p) for p in owner.parameters()} == {id(p) for p in flow.parameters()}


STORED = {
    "alone": lambda make: make(),
    "in a chain": lambda make: TransformedEnv(track(), Compose(make().transform, StepCounter())),
    "in a series": lambda make: SerialEnv(2, make),
    "around a series": lambda make: TransformedEnv(SerialEnv(2, track), make().transform),
}


def load(new, old, path):
    new.load_state_dict(old.state_dict())


def directory(new, old, path):
    Checkpoint(env=old).save(path / "stored")
    Checkpoint(env=new).load(path / "stored")


def archive(new, old, path):
    Checkpoint(env=old).save(path / "stored.zip", format="archive")
    Checkpoint(env=new).load(path / "stored.zip")


# TorchRL's checkpoint does not take a series that was never reset, whatever is in it.
CASES = [(load, case) for case in STORED] + [(directory, "alone"), (archive, "in a chain")]


@pytest.mark.parametrize(("move", "case"), CASES)
def test_the_state_of_an_environment_loads_into_one_that_is_new(move, case, tmp_path):
    def make():
        box = {"action_low": [-1.0, -1.5], "action_high": [1.0, 1.5]}
        return TransformedEnv(track(**box), ActionFlowTransform(Dubins()))

    old, new = (STORED[case](make) for _ in range(2))
    old.rollout(2)
    changed = tree_map(lambda x: x + 1.0 if x.is_floating_point() else x, old.state_dict())
    old.load_state_dict(changed)
    move(new, old, tmp_path)
    found, expected = tree_leaves(new.state_dict()), tree_leaves(changed)
    assert len(found) == len(expected) > 0
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    new.rollout(2)


class Team(EnvBase):
    """Three cars under one action key, driven backwards; episodes end together or one by one."""

    def __init__(self, batch=(), ends="root", size=3):
        super().__init__(batch_size=batch)
        group, batch = (*batch, size), torch.Size(batch)

        def agents(**entries):
            return Composite(agents=Composite(**entries, shape=group), shape=batch)

        self.observation_spec = agents(observation=Unbounded((*group, 3)))
        self.action_spec = agents(action=Bounded(-1.0, 1.0, (*group, 2)))
        self.reward_spec = agents(reward=Unbounded((*group, 1)))
        own = agents(done=Binary(1, (*group, 1), dtype=torch.bool))
        of_all = Composite(done=Binary(1, (*batch, 1), dtype=torch.bool), shape=batch)
        self.done_spec = own if ends == "agents" else of_all

    def _reset(self, tensordict=None, **kwargs):
        self.steps = torch.zeros(self.full_done_spec[self.done_keys[0]].shape)
        return self.full_done_spec.zero().update(self.observation_spec.zero())

    def _step(self, tensordict):
        seen, action = (tensordict["agents", name] for name in ("observation", "action"))
        self.steps = self.steps + 1
        out = self.full_done_spec.zero().update(self.observation_spec.zero())
        out["agents", "observation"] = Dubins()(seen, -action)
        return out.set(self.done_keys[0], self.steps >= 5).update(self.reward_spec.zero())

    def _set_seed(self, seed):
        pass


AGENTS = {"in_keys": [("agents", "observation")], "in_keys_inv": [("agents", "action")]}


OWN = ("agents", "afm")


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize(("ends", "prefix"), [("root", "afm"), ("root", OWN), ("agents", OWN)])
def test_agents_under_one_key_have_a_memory_each(batch, ends, prefix):
    env = TransformedEnv(Team(batch, ends), ActionFlowTransform(Dubins(), prefix=prefix, **AGENTS))
    check_env_specs(env, break_when_any_done="both")
    found = env.rollout(9, break_when_any_done=False)["next", prefix]
    assert found["executed_action"].shape == (*batch, 9, 3, 2)
    corrects = found["corrected"].movedim(len(batch), 0)
    assert corrects[4].all() and not corrects[5].any() and corrects[-1].all()


def test_a_prefix_that_is_not_reset_with_the_agents_is_refused():
    env = TransformedEnv(Team((), "agents"), ActionFlowTransform(Dubins(), **AGENTS))
    with pytest.raises(ConfigurationError, match=r"prefix='afm': .* such as \('agents', 'afm'\)"):
        env.reset()
