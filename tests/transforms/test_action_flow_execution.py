"""Which action is executed."""

import math
import os

import pytest
import torch
from shells import BOX as UNIT
from shells import MODEL, pucks
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.correction import Corrector
from afm_rl.dynamics import Calibrated, Dubins, Oracle
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform
from afm_rl.transforms.loop import CorrectionLoop

LOW, HIGH = torch.tensor([-1.0, -math.pi / 2]), torch.tensor([1.0, math.pi / 2])
BOX = torch.stack([LOW, HIGH])


class Stub(Corrector):
    """Gives a fixed kind of answer once it has seen a transition."""

    def __init__(self, inverse=torch.neg, low=LOW, high=HIGH, **others):
        super().__init__(low, high, recent=2)
        self.inverse, self.others, self.asked = inverse, others, []

    def answer(self, memory, planned, model, bounds, limits):
        self.asked.append(planned)
        seen = memory["valid"][..., -1, 0] == 1.0
        found = self.unchanged(planned, seen.to(planned), bounds)
        executed = torch.where(seen.unsqueeze(-1), self.inverse(planned), planned)
        return {}, found._replace(executed_action=executed, corrected=seen, **self.others)


def env(corrector, *before, batch=(4,), model=None, **settings):
    base = UGVTrack(batch_size=batch, process_noise=0.0)
    chain = ActionFlowTransform(model or Dubins(), corrector, **settings)
    return TransformedEnv(base, Compose(*before, chain))


@pytest.mark.parametrize("enabled", [True, False])
def test_a_correction_comes_with_the_effect_that_it_is_predicted_to_have(enabled):
    foreseen = torch.rand(4, 2)
    data = env(Stub(predicted_effect=foreseen), enabled=enabled).rollout(4)
    entries = data["next", "afm"]
    wanted = foreseen.unsqueeze(1).expand(4, 4, 2) if enabled else data["action"]
    torch.testing.assert_close(entries["predicted_effect"], wanted)
    assert entries["corrected"][:, 1:].all()


ANSWERS = [math.nan, math.inf, -math.inf, 1e30, -1e30, 3.0, -3.0, 0.1]


@pytest.mark.parametrize("batch", [(), (64,), (8, 8)], ids=str)
def test_only_finite_actions_in_the_box_are_executed_whatever_is_answered(batch):
    """The last clamp depends on the spec alone: also where a box is not around zero."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape):
        values = torch.tensor(ANSWERS)
        return values[torch.randint(len(values), (*batch, *shape), generator=generator)]

    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 1.5])
    spec = Bounded(low, high)
    sizes = {"predicted_effect": (2,), "effect_bounds": (2, 2)}
    for _ in range(10):
        answer, others = drawn(2), {name: drawn(*size) for name, size in sizes.items()}
        corrector = Stub(lambda _, answer=answer: answer, low, high, **others)
        memory = corrector.observe(corrector.begin(torch.zeros(*batch, 3)), torch.ones(*batch, 3))
        memory, step = CorrectionLoop("test", Dubins(), corrector).act(memory, drawn(2), spec)
        executed = step.executed_action
        assert step.corrected.all()
        assert ((executed >= low) & (executed <= high)).all()
        assert torch.equal(memory["executed_action"], executed)
        held = ~answer.isfinite().all(-1)
        assert (executed[held] == torch.zeros(2).clamp(low, high)).all()  # the last one


NO_NUMBERS = {
    "shape": (torch.zeros(4, 3), r"'%s': torch.float32 \(4, 3\), expected .* \(4, %d\)"),
    "text": ("left", r"'%s': NonTensorData, expected real numbers \(4, %d\)"),
    "missing": (None, r"'%s': NoneType, expected real numbers \(4, %d\)"),
}


@pytest.mark.parametrize("case", NO_NUMBERS)
@pytest.mark.parametrize(("key", "size"), [("action", 2), ("observation", 4)])
def test_what_is_no_action_and_no_state_is_refused_by_name(case, key, size):
    given, words = NO_NUMBERS[case]

    def put(td):
        return td.exclude(key) if given is None else td.set(key, given)

    policy = ActionFlowPolicy(MODEL, Bounded(*UNIT))
    td = policy.make_tensordict_primer()(TensorDict(batch_size=[4]))
    td.update({"observation": torch.zeros(4, 4), "action": torch.zeros(4, 2)})
    with pytest.raises(ConfigurationError, match=words % (key, size)):
        policy(put(td.clone()))
    whole = pucks(1.0, ActionFlowTransform(MODEL))
    td = whole.reset(TensorDict({"observation": torch.zeros(4, 4)}, [4]))
    td["action"] = torch.zeros(4, 2)
    with pytest.raises(ConfigurationError, match=words % (key, size)):
        if key == "action":
            whole.transform._inv_call(put(td))
        else:
            whole.transform._step(whole.transform._inv_call(td), put(td.clone()))


WIDER = {
    "extended": {},
    "not wished": {"extend_effect_bounds": False},
    "switched off": {"enabled": False},
    "a network": {"model": "ensemble"},
    "calibrated": {"model": Calibrated(Dubins(), HIGH)},
    "oracle": {"model": Oracle(Dubins(), ActionGain(["v", "omega"]))},
}


@pytest.mark.parametrize("name", WIDER)
def test_planners_hear_of_more_only_if_they_may_and_the_model_can_foresee_it(name, make_ensemble):
    settings = dict(WIDER[name])
    if settings.get("model") == "ensemble":
        settings["model"] = make_ensemble()
    bounds = 2.5 * BOX.expand(4, 2, 2)
    found = env(Stub(effect_bounds=bounds), **settings).rollout(3)["next", "afm", "effect_bounds"]
    wider = name in ("extended", "calibrated", "oracle")
    torch.testing.assert_close(found[:, -1], bounds if wider else BOX.expand(4, 2, 2))


def test_with_two_the_last_hears_the_planner_first():
    base = UGVTrack(batch_size=(4,))
    inner = ActionFlowTransform(Dubins(), Stub(lambda a: 0.5 * a), prefix="inner")
    outer = ActionFlowTransform(Dubins(), Stub(), prefix="outer")
    data = TransformedEnv(base, Compose(inner, outer)).rollout(4)
    assert torch.equal(data["next", "outer", "planned_action"], data["action"])
    between = data["next", "outer", "executed_action"]
    torch.testing.assert_close(data["next", "inner", "planned_action"], between)
    executed = data["next", "inner", "executed_action"][:, 1:]
    torch.testing.assert_close(executed, -0.5 * data["action"][:, 1:])


def test_the_present_model_is_asked(make_ensemble, flow):
    model = make_ensemble()
    whole = env(flow, model=model)
    td = step_mdp(whole.rollout(4)[:, -1])
    td["action"] = torch.zeros(4, 2)
    begun = whole.state_dict()

    def effects():
        return whole.transform[0].memory["effects"]

    def innovation():
        whole.load_state_dict(begun)
        return whole.step(td.clone())["next", "afm", "innovation"]

    older, before = effects(), innovation()
    for parameter in model.parameters():
        parameter.data *= 0.5
    innovation()
    assert torch.equal(effects()[..., :-1], older[..., 1:])
    model.taught_in = os.getpid()  # it learns: what was found before no longer holds
    assert not torch.allclose(before, innovation())
    for parameter in model.parameters():
        parameter.data *= 2.0
    torch.testing.assert_close(innovation(), before)
