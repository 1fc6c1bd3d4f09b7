"""The action flow transform does what TorchRL asks of every transform."""

import pytest
import torch
from harness import HIGH, LOW
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv
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
