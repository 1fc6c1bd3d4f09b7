"""Which action is executed."""

import math
import os

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins, dubins_step
from afm_rl.envs import UGVTrack
from afm_rl.flow import Context, ContextFlow, Correction, Corrector
from afm_rl.learning import GaussianNLLLoss
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.transforms import ActionFlowTransform

LOW, HIGH = torch.tensor([-1.0, -math.pi / 2]), torch.tensor([1.0, math.pi / 2])


class Stub(Corrector):
    """Opens the gate once it has seen a transition, and gives a fixed kind of answer."""

    feature_size = 1

    def __init__(self, answer, window=2, foresee=None):
        super().__init__(LOW, HIGH, gate=0.0, window=window)
        self.answer, self.foresee, self.asked = answer, foresee, []

    def context(self, window, model, last):
        size = window.valid.sum(-1).to(window.state)
        none = size.unsqueeze(-1)[..., :0]
        pairs = none.unsqueeze(-2).expand(*window.valid.shape, 0)
        return Context(pairs, none, size.unsqueeze(-1), size, size > 0)

    def correct(self, context, state, planned):
        self.asked.append((context, state, planned))
        expected = None if self.foresee is None else self.foresee(planned)
        spread = torch.full_like(planned, 0.1)
        return Correction(self.answer(planned), spread, expected=expected)


class Blind(Transform):
    """A sensor that gives a faulty pose at some steps, to every second mission."""

    def __init__(self, steps, value):
        super().__init__(in_keys=["observation"])
        self.steps, self.value = steps, value

    def _step(self, tensordict, next_tensordict):
        faulty = torch.isin(next_tensordict["step"], torch.tensor(self.steps))
        faulty = faulty & (torch.arange(len(faulty)) % 2 == 0)
        pose = next_tensordict["observation"]
        seen = torch.where(faulty.unsqueeze(-1), self.value, pose)
        return next_tensordict.set("observation", seen)

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def env(answer, *before, batch=(4,), **settings):
    base = UGVTrack(batch_size=batch, process_noise=0.0)
    chain = ActionFlowTransform(Dubins(), Stub(answer), **settings)
    return TransformedEnv(base, Compose(*before, chain))


def test_the_plan_stays_and_its_correction_is_executed():
    data = env(lambda planned: -0.5 * planned).rollout(6)
    memory = data["next", "afm"]
    assert torch.equal(memory["planned_action"], data["action"])
    factor = torch.tensor([1.0] + [-0.5] * 5).view(1, 6, 1)  # the first finds the gate closed
    torch.testing.assert_close(memory["executed_action"], factor * data["action"])
    moved = dubins_step(data["pose"], memory["executed_action"], 0.2)
    torch.testing.assert_close(data["next", "pose"], moved)
    assert torch.equal(memory["misaligned"], (factor < 0).squeeze(-1).expand(4, 6))
    spread = 0.1 * (factor < 0).expand(4, 6, 2)
    torch.testing.assert_close(memory["spread"], spread)


def half_foreseen(planned):
    foreseen = 0.25 * planned
    foreseen[0] = math.nan
    return foreseen


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("foresee", [None, half_foreseen])
def test_what_is_expected_of_an_action_is_told(enabled, foresee):
    """Of an aligned model what is executed; of who says nothing, or no number, what is planned."""
    chain = ActionFlowTransform(Dubins(), Stub(torch.neg, foresee=foresee), enabled=enabled)
    data = TransformedEnv(UGVTrack(batch_size=(4,)), chain).rollout(4)
    memory, planned = data["next", "afm"], data["action"]
    wanted = memory["executed_action"].clone()
    if enabled:
        wanted[:, 1:] = planned[:, 1:]
        if foresee is not None:
            wanted[1:, 1:] = 0.25 * planned[1:, 1:]
    torch.testing.assert_close(memory["expected_action"], wanted)


def test_the_action_given_is_not_overwritten():
    whole = env(lambda planned: -planned)
    td = step_mdp(whole.step(whole.rand_action(whole.reset())))
    action = torch.full((4, 2), 0.4)
    td["action"] = action
    whole.step(td)
    assert torch.equal(action, torch.full((4, 2), 0.4)) and td["action"] is not None
    assert torch.equal(td["action"], torch.full((4, 2), 0.4))


def test_only_what_is_misaligned_is_corrected():
    chain = ActionFlowTransform(Dubins(), Stub(lambda planned: -planned))
    whole = TransformedEnv(UGVTrack(batch_size=(4,)), chain)
    td = whole.reset()
    action = torch.arange(8.0).view(4, 2) / 10
    td["action"] = action.clone()
    td = step_mdp(whole.step(td))
    td["afm", "window", "valid"][:2] = False  # two have just begun
    td["action"] = action.clone()
    executed = whole.step(td)["next", "afm", "executed_action"]
    assert torch.equal(executed, torch.cat([action[:2], -action[2:]]))
    ((context, state, planned),) = chain.flow.asked
    assert torch.equal(planned, action[2:]) and torch.equal(state, td["afm", "state"][2:])
    assert [len(part) for part in context] == [2] * len(context)


@pytest.mark.parametrize("size", [3.0, 1e30])
def test_what_is_executed_is_in_the_box(size):
    whole = env(lambda planned: size * planned.sign())
    data = whole.rollout(5)
    executed = data["next", "afm", "executed_action"]
    assert (executed >= LOW).all() and (executed <= HIGH).all()
    torch.testing.assert_close(executed[:, 1:], (data["action"].sign() * HIGH)[:, 1:])


def test_a_plan_outside_the_box_is_brought_into_it():
    whole = env(lambda planned: planned)
    td = whole.reset()
    td["action"] = torch.full((4, 2), 9.0)
    memory = whole.step(td)["next", "afm"]
    assert torch.equal(memory["planned_action"], torch.full((4, 2), 9.0))
    torch.testing.assert_close(memory["executed_action"], HIGH.expand(4, 2))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_answer_that_is_not_finite_is_not_executed(value):
    def answer(planned):
        answered = -planned
        answered[0] = value
        answered[1, 1] = value
        return answered

    data = env(answer).rollout(4)
    executed, planned = data["next", "afm", "executed_action"], data["action"]
    assert torch.equal(executed[:2], planned[:2])
    torch.testing.assert_close(executed[2:, 1:], -planned[2:, 1:])
    assert (data["next", "afm", "spread"][:2] == 0).all()


def test_switched_off_it_only_watches():
    whole = env(lambda planned: -planned, enabled=False)
    data = whole.rollout(4)
    memory = data["next", "afm"]
    assert torch.equal(memory["executed_action"], data["action"])
    assert memory["misaligned"][:, 1:].all() and (memory["spread"] == 0).all()
    whole.transform[0].enabled = True
    data = whole.rollout(4)
    torch.testing.assert_close(
        data["next", "afm", "executed_action"][:, 1:], -data["action"][:, 1:]
    )


def test_with_two_the_last_hears_the_planner_first():
    base = UGVTrack(batch_size=(4,))
    inner = ActionFlowTransform(Dubins(), Stub(lambda a: 0.5 * a), prefix="inner")
    outer = ActionFlowTransform(Dubins(), Stub(lambda a: -a), prefix="outer")
    data = TransformedEnv(base, Compose(inner, outer)).rollout(4)
    assert torch.equal(data["next", "outer", "planned_action"], data["action"])
    between = data["next", "outer", "executed_action"]
    torch.testing.assert_close(data["next", "inner", "planned_action"], between)
    executed = data["next", "inner", "executed_action"][:, 1:]
    torch.testing.assert_close(executed, -0.5 * data["action"][:, 1:])


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf, 1e30])
def test_a_faulty_sensor_does_not_reach_the_motors(fault, box):
    flow = ContextFlow(*box, window=3, memory=7, hidden=[8], latent=4)
    chain = Compose(Blind([4, 5], fault), ActionFlowTransform(Dubins(), flow))
    whole = TransformedEnv(UGVTrack(batch_size=(4,), process_noise=0.0), chain)
    data = whole.rollout(12)
    memory = data["next", "afm"]
    assert memory["executed_action"].isfinite().all()
    assert memory["features"].isfinite().all() and memory["surprise"].isfinite().all()
    assert (memory["surprise"][1::2] < 0.1).all()  # the others notice nothing
    assert (memory["surprise"][:, -1] < 0.1).all()  # and afterwards all is well again
    if not math.isfinite(fault):
        assert not memory["misaligned"].any()
        valid = memory["window", "valid"]
        touched = torch.tensor([step in (3, 4, 5) for step in range(12)])  # next or last pose
        assert torch.equal(valid[0, :, -1], ~touched)
        assert valid[1].all(-1)[flow.window :].all()


def test_the_present_model_is_asked(make_ensemble, box):
    model = make_ensemble()
    flow = ContextFlow(*box, window=3, memory=7, hidden=[8], latent=4)
    whole = TransformedEnv(UGVTrack(batch_size=(4,)), ActionFlowTransform(model, flow))
    td = step_mdp(whole.rollout(4)[:, -1])
    td["action"] = torch.zeros(4, 2)
    pairs = td["afm", "pairs"]
    before = whole.step(td.clone())["next", "afm", "surprise"]
    for parameter in model.parameters():
        parameter.data *= 0.5
    assert torch.equal(whole.step(td.clone())["next", "afm", "pairs"][:, :-1], pairs[:, 1:])
    model.taught_in = os.getpid()  # it learns: what was found before no longer holds
    after = whole.step(td.clone())["next", "afm", "surprise"]
    assert not torch.allclose(before, after)
    for parameter in model.parameters():
        parameter.data *= 2.0
    torch.testing.assert_close(whole.step(td.clone())["next", "afm", "surprise"], before)


def test_losses_can_read_the_executed_action():
    data = env(lambda planned: -planned).rollout(4).reshape(-1)
    loss = GaussianNLLLoss(Dubins(), reduction="none")
    assert (loss(data)["loss_nll"] > 1).any()
    loss.set_keys(action=("next", "afm", "executed_action"))
    torch.testing.assert_close(loss(data)["loss_nll"], torch.zeros(16), rtol=0, atol=1e-4)


def test_an_aligned_robot_is_left_alone(trained_flow):
    missions = {"track": 0, "regime": {}}
    base = UGVTrack(batch_size=(4,), missions=missions)  # with its process noise
    data = TransformedEnv(base, ActionFlowTransform(Dubins(), trained_flow)).rollout(20)
    memory = data["next", "afm"]
    assert not memory["misaligned"].any()
    assert torch.equal(memory["executed_action"], data["action"])


def test_a_robot_with_reversed_drive_arrives_with_it_and_not_without(trained_flow):
    reached = []
    for enabled in (True, False):
        world = PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH)
        planner = MPPI(world, horizon=5, population=64)
        base = UGVTrack(
            batch_size=(2,),
            schedule=Schedule([]),
            missions={"regime": {"v_gain": -1.0}},
            action_low=LOW.tolist(),
            action_high=HIGH.tolist(),
        )
        chain = ActionFlowTransform(Dubins(), trained_flow, enabled=enabled)
        whole = TransformedEnv(base, Compose(chain, planner.make_tensordict_primer()))
        data = whole.rollout(80, planner, break_when_any_done=False)
        assert data["next", "afm", "misaligned"][:, 2:].float().mean() > 0.9
        reached.append(int(data["next", "reached"][:, -1].sum()))
    assert reached[0] > 2 * reached[1]


def test_missions_may_leave_a_free_batch():
    base = UGVTrack(process_noise=0.0)
    whole = TransformedEnv(base, ActionFlowTransform(Dubins(), Stub(lambda planned: -planned)))
    td = whole.reset(TensorDict(batch_size=[4]), set_state=False)
    for count in (4, 4, 2, 1):
        td = td[:count]
        td["action"] = torch.full((count, 2), 0.3)
        td = whole.step(td)
        executed = td["next", "afm", "executed_action"]
        assert executed.shape == (count, 2)
        td = step_mdp(td)
    torch.testing.assert_close(executed, torch.full((1, 2), -0.3))
