"""What holds in whichever shell the correction is: transform, policy, controller or wrapper."""

import warnings

import numpy as np
import pytest
import torch
from shells import BOX, EPISODE, MODEL, plans_of, pucks, wrapper
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import step_mdp

from afm_rl.correction import LeastSquares, first_steps
from afm_rl.errors import ConfigurationError
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform


def missed(shell, plans, dtype=torch.float32, **settings):
    """Return how far each action is from the one that is right, the plan's opposite."""
    executed = torch.stack([each.double() for each in shell(plans, dtype, **settings)])
    assert not executed.requires_grad and executed.isfinite().all()
    return (executed + torch.stack(list(plans)).detach().double()).abs().amax(-1)


def test_what_was_learnt_outlasts_resets_if_it_shall(shell):
    plans = plans_of(60)
    assert (missed(shell, plans[:30]) > 0.1).double().mean() > 0.2
    assert (missed(shell, plans, keep_memory_on_reset=True) > 0.1).double().mean() <= 0.05


SIXTEEN = {
    "gradients": (lambda plan: plan.clone().requires_grad_(), torch.float32),
    "bfloat16 actions": (lambda plan: plan.bfloat16(), torch.float32),
    "float16 actions": (lambda plan: plan.half(), torch.float32),
    "float16 observations": (lambda plan: plan, torch.float16),
}


@pytest.mark.parametrize("case", SIXTEEN)
def test_gradients_and_16_bits_are_served(shell, case):
    change, dtype = SIXTEEN[case]
    assert (missed(shell, [change(plan) for plan in plans_of(EPISODE)], dtype)[4:] < 0.15).all()


@pytest.mark.parametrize("when", ["reset", "step"])
def test_a_default_type_of_16_bits_is_refused(shell, when):
    running = shell(plans_of(EPISODE), torch.float32)
    if when == "step":
        next(running)
    torch.set_default_dtype(torch.bfloat16)
    try:
        with pytest.raises(ConfigurationError, match="default_dtype.. is torch.bfloat16: expected"):
            next(running)
    finally:
        torch.set_default_dtype(torch.float32)


def test_while_nothing_is_wrong_and_while_it_only_watches_plans_are_executed(shell):
    plans = plans_of(20)
    for how in ({"gain": 1.0}, {"enabled": False}):
        torch.testing.assert_close(
            torch.stack(list(shell(plans, torch.float32, ends=99, **how))), plans
        )


@pytest.fixture
def warned(monkeypatch):
    """Return what is warned of in an episode, if it has such words; 24 steps are judged, not 60."""
    monkeypatch.setattr(first_steps, "STEPS", 24)
    monkeypatch.setattr(first_steps, "CALM", 8)

    def run(shell, words, **how):
        with warnings.catch_warnings(record=True) as issued:
            warnings.simplefilter("always")
            list(shell(0.5 * plans_of(30), torch.float32, ends=200, **how))
        return [str(w.message) for w in issued if words in str(w.message)]

    return run


def test_a_correction_from_the_first_steps_on_is_said_once(shell, warned):
    (text,) = warned(shell, "were corrected", gain=0.5)
    assert "(gain 0.5 on all: dt or a unit of the model?)" in text


def test_switched_off_plans_are_executed_to_the_bit_and_evidence_is_gathered(shell):
    plans, switch = plans_of(40), {1: False, 20: True, 25: False, 35: True}
    executed = torch.stack(list(shell(plans, torch.float32, ends=99, switch=switch)))
    off = [*range(1, 20), *range(25, 35)]
    on = [*range(20, 25), *range(35, 40)]
    assert executed[off].equal(plans[off])
    assert ((executed + plans)[on].abs() < 0.05).all()


LIMITS = {
    "by axis": {"max_correction": [0.1, 2.0]},
    "both": {"max_correction": 0.4, "max_correction_rate": [0.1, 0.05]},
}


@pytest.mark.parametrize("case", LIMITS)
def test_no_command_is_beyond_the_limits_and_what_they_leave_is_used(shell, case):
    plans, limits = 0.3 * plans_of(30), LIMITS[case]
    executed = torch.stack(list(shell(plans, torch.float32, ends=99, **limits)))
    moved = executed - plans
    most, rate = (
        torch.tensor(limits.get(name, 2.0)) for name in ("max_correction", "max_correction_rate")
    )
    assert (moved.abs() <= most + 1e-6).all() and (moved.diff(dim=0).abs() <= rate + 1e-6).all()
    for plan, before, now in zip(plans[12:], moved[11:], moved[12:], strict=False):
        wanted = (-2 * plan).clamp(before - rate, before + rate).clamp(-most, most)
        torch.testing.assert_close(now, wanted, atol=0.05, rtol=0)  # it knows what acted


CORRECTED, HELD = "were corrected", "held back by the limits max_correction and"
SAID = [  # settings, words of a warning, and the cause in it; None: nothing is said
    ({"gain": 1.0}, CORRECTED, None),
    ({"gain": 0.5, "enabled": False}, CORRECTED, None),
    ({"gain": np.array([1.0, -0.5])}, CORRECTED, "gain 1, -0.5: a sign of the model"),
    ({"corrector": LeastSquares(*BOX)}, CORRECTED, "gain -1 on all: a sign of the model"),
    ({"max_correction": 0.1}, HELD, "(gain -1 on all"),
    ({"max_correction_rate": 0.01}, HELD, "(gain -1 on all"),
    ({"max_correction": 2.0}, HELD, None),
    ({"max_correction": 0.1, "gain": 1.0}, HELD, None),
]


@pytest.mark.parametrize(("how", "words", "cause"), SAID)
def test_a_lasting_correction_and_limits_that_hold_it_back_are_said(how, words, cause, warned):
    texts = warned(wrapper, words, **how)
    assert len(texts) == (cause is not None) and all(cause in text for text in texts)


def test_an_entry_switches_missions_of_a_batch_off_one_by_one():
    """The predicted effect of a limited action is its real effect."""
    env = pucks(-1.0, ActionFlowTransform(MODEL, max_correction=0.5))
    pure, plans = ActionFlowPolicy(MODEL, Bounded(*BOX), max_correction=0.5), plans_of(30)
    td = env.reset(TensorDict({"observation": torch.zeros(2, 4)}, [2]))
    other = pure.make_tensordict_primer()(TensorDict({}, [2]))
    for k, plan in enumerate(plans):
        if k == 20:
            for each in (td, other):
                each["afm", "enabled"] = torch.tensor([True, False])
        other["observation"], other["action"] = td["observation"], plan.expand(2, 2)
        other = pure(other)
        td = env.step(td.set("action", plan.expand(2, 2)))["next"]
        executed = td["afm", "executed_action"]
        assert executed.equal(other["action"])
        other = step_mdp(other)
        if k > 12:
            told = td["afm", "predicted_effect"][0]
            torch.testing.assert_close(told, -executed[0], atol=0.1, rtol=0)
            assert not executed[0].equal(plan) and executed[1].equal(plan) is (k >= 20)
    env.transform.load_state_dict(env.transform.state_dict())
    assert td["afm", "enabled"].tolist() == [True, False]
