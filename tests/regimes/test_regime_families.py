"""What all regimes have in common, and what each does to an action."""

import math
import re

import pytest
import torch
from harness import refused
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.errors import ConfigurationError
from afm_rl.regimes import (
    ActionGain,
    Actuators,
    AsymmetricGain,
    Backlash,
    Bias,
    Compose,
    DeadActuator,
    DeadZone,
    Delay,
    GainNoise,
    InertiaFactor,
    Lag,
    MassFactor,
    MotorEfficiency,
    Patches,
    Payload,
    Permutation,
    Quantisation,
    Rotation,
    Saturation,
    WheelSlip,
    Wind,
    flight_regimes,
)
from afm_rl.spaces.airframe import QuadrotorBody

HALF = [1.0, 1.5]
LOW, HIGH = -torch.tensor(HALF), torch.tensor(HALF)
STATE = torch.zeros(3)
NAMES = ["v_bias", "omega_bias"]
FAMILIES = {
    "gain": ActionGain(["v_gain", "omega_gain"]),
    "bias": Bias(NAMES, HALF),
    "rotation": Rotation(HALF),
    "saturation": Saturation(HALF),
    "dead_zone": DeadZone(HALF),
    "slip": WheelSlip(HALF),
    "delay": Delay(),
    "patches": Patches(),
    "gain_noise": GainNoise(),
    "permutation": Permutation(["v_from", "omega_from"], HALF),
    "dead": DeadActuator(["v_loss", "omega_loss"]),
    "asymmetric": AsymmetricGain(["v", "omega"]),
    "quantisation": Quantisation(HALF),
    "backlash": Backlash(HALF),
    "lag": Lag(),
}
COMPOSED = "delay", "dead_zone", "rotation", "gain", "gain_noise", "bias"
FAMILIES["composed"] = Compose(
    {name: FAMILIES[name] for name in COMPOSED},
    prior=[["gain"], ["gain", "rotation"], ["bias", "dead_zone"]],
)
FLIGHT = {
    "mass": MassFactor(),
    "inertia": InertiaFactor(),
    "motors": MotorEfficiency(),
    "payload": Payload(),
    "wind": Wind(),
    "flight": flight_regimes(),
}
FAMILIES |= FLIGHT
every_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)


def box(family):
    """Return lowest and highest actions of the robot that has these regimes."""
    flies = any(family is other for other in FLIGHT.values())
    return map(torch.tensor, QuadrotorBody().bounds) if flies else (LOW, HIGH)


def drawn(family, count=400, dtype=torch.float64):
    """Return actions in the box, parameters from the prior and places."""
    generator = torch.Generator().manual_seed(0)
    low, high = box(family)
    action = low + (high - low) * torch.rand(count, len(low), generator=generator, dtype=dtype)
    state = 10 * torch.rand(count, 13, generator=generator, dtype=dtype) - 5
    return action, family.sample((count,), generator).to(dtype), state


@every_family
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_nominal_regime_keeps_every_action_to_the_bit(family, dtype):
    action, _, state = drawn(family, dtype=dtype)
    nominal = family.encode({}).to(dtype).expand(400, -1)
    past = torch.rand(400, family.history, action.shape[-1], dtype=dtype)
    noise, endless = torch.randn_like(action), torch.full_like(action[0], torch.inf)
    assert family.is_identity(nominal).all()
    assert torch.equal(family.apply(action, nominal, state), action)
    assert torch.equal(family.apply(action, nominal, state, past, noise), action)
    assert torch.equal(family.inverse(action, nominal, state, -endless, endless), action)


@every_family
def test_what_an_action_can_be_worth_is_had_by_the_inverse(family):
    commanded, rows, state = drawn(family)
    wanted = family.apply(commanded, rows, state)
    endless = torch.full_like(wanted[0], torch.inf)
    command = family.inverse(wanted, rows, state, -endless, endless)
    torch.testing.assert_close(family.apply(command, rows, state), wanted, rtol=0, atol=2e-6)
    assert family.closed_form


def test_the_inverse_is_that_of_an_effect_of_ones_own():
    class Weak(ActionGain):
        def effect_of(self, action, parameters):
            return 0.5 * super().effect_of(action, parameters)

    gains = torch.tensor([-1.0, 0.8])
    wanted = torch.tensor([0.3, -0.2])
    family = Weak(["v_gain", "omega_gain"])
    command = family.inverse(wanted, gains, STATE, LOW, HIGH)
    torch.testing.assert_close(command, wanted / (0.5 * gains), atol=0.01, rtol=0)
    assert not family.closed_form
    assert all(kind.closed_form for kind in (ActionGain(["v_gain", "omega_gain"]), Delay(), Lag()))


@every_family
def test_the_inverse_stays_in_the_box(family):
    wanted, rows, state = drawn(family)
    low, high = box(family)
    command = family.inverse(3 * wanted, rows, state, low, high)
    assert ((command >= low) & (command <= high)).all()


@every_family
def test_a_batch_is_what_its_rows_are_alone(family):
    action, rows, state = drawn(family, 20)
    past, noise = torch.rand(20, 8, action.shape[-1]).double(), torch.randn_like(action)
    ends = list(box(family))
    whole = family.apply(action, rows, state, past, noise)
    back = family.inverse(action, rows, state, *ends)
    for k in (0, 7, 19):
        one = family.apply(action[k], rows[k], state[k], past[k], noise[k])
        torch.testing.assert_close(whole[k], one)
        torch.testing.assert_close(back[k], family.inverse(action[k], rows[k], state[k], *ends))
    wide = family.apply(action.unsqueeze(1), rows.unsqueeze(1), state.unsqueeze(1))
    torch.testing.assert_close(wide.squeeze(1), family.apply(action, rows, state))


@every_family
@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_the_generator_decides_the_draw(family, shape):
    rows = [family.sample(shape, torch.Generator().manual_seed(seed)) for seed in (1, 1)]
    assert rows[0].shape == (*shape, len(family.names))
    assert torch.equal(*rows)
    values = dict(zip(family.names, family.sample((), None).tolist(), strict=True))
    assert family.encode(values).tolist() == pytest.approx(list(values.values()))


@pytest.mark.parametrize(
    ("family", "least", "most"),
    [
        ("bias", [-0.4, -0.4], [0.4, 0.4]),
        ("slip", [0.2, 0.3], [0.8, 0.9]),
        ("delay", [1.0], [2.0]),
        ("patches", [-1.5, 1.0], [-0.5, 1.0]),
        ("permutation", [0.0, 0.0], [1.0, 1.0]),
        ("asymmetric", [0.3] * 4, [1.5] * 4),
    ],
)
def test_the_prior_covers_its_range(family, least, most):
    rows = FAMILIES[family].sample((4000,), torch.Generator().manual_seed(0))
    torch.testing.assert_close(rows.amin(0), torch.tensor(least), rtol=0, atol=0.01)
    torch.testing.assert_close(rows.amax(0), torch.tensor(most), rtol=0, atol=0.01)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-4, 4))
def test_a_rotation_keeps_the_length_in_half_ranges(v, omega, angle):
    action = torch.tensor([v, omega * 1.5], dtype=torch.float64)
    row = torch.tensor([angle], dtype=torch.float64)
    effect = FAMILIES["rotation"].apply(action, row, torch.zeros(3)) / HIGH
    assert float(effect.norm()) == pytest.approx(math.hypot(v, omega), abs=1e-9)


def test_gains_change_from_patch_to_patch():
    places = torch.tensor([[1.0, 1.0], [3.0, 1.0], [3.0, 3.0], [-1.0, 1.0], [-1.0, -1.0]])
    row = FAMILIES["patches"].encode({"patch_v_gain": -1.0})
    effect = FAMILIES["patches"].apply(torch.ones(5, 2), row, places)
    assert effect.tolist() == [[k, 1] for k in (1, -1, 1, -1, 1)]


def test_no_effect_is_wanted_by_no_command_in_a_dead_zone():
    row = FAMILIES["dead_zone"].encode({"dead_zone": 0.4})
    assert FAMILIES["dead_zone"].inverse(torch.zeros(2), row, STATE, LOW, HIGH).tolist() == [0, 0]


def test_more_traction_than_there_is_takes_the_command_of_the_peak():
    family = FAMILIES["slip"]
    row = family.encode({"slip_at": 0.5, "slip_peak": 0.8})
    found = family.inverse(torch.tensor([-0.9, 1.4]), row, STATE, LOW, HIGH)
    torch.testing.assert_close(found, torch.tensor([-0.5, 0.75]))
    nothing = family.encode({"slip_at": 0.5, "slip_peak": 0.0})
    assert family.inverse(torch.zeros(2), nothing, STATE, LOW, HIGH).tolist() == [0, 0]


PAST = torch.tensor([[0.2, 0.3], [-0.6, 0.5], *[[0.0, 0.0]] * 5, [0.7, 0.1]])


@pytest.mark.parametrize(
    ("steps", "effect"),
    [
        (0.0, [1.0, 1.0]),
        (1.0, [0.2, 0.3]),
        (2.0, [-0.6, 0.5]),
        (8.0, [0.7, 0.1]),
        (0.5, [0.6, 0.65]),
    ],
)
def test_a_delay_picks_the_command_of_that_many_steps_ago(steps, effect):
    found = FAMILIES["delay"].apply(torch.ones(2), torch.tensor([steps]), STATE, PAST)
    torch.testing.assert_close(found, torch.tensor(effect))


def test_without_a_past_or_noise_the_command_acts():
    for name, values in (("delay", {"delay": 2}), ("gain_noise", {"gain_noise": 0.3})):
        row = FAMILIES[name].encode(values)
        assert FAMILIES[name].apply(torch.ones(2), row, STATE).tolist() == [1, 1]


def test_a_permutation_of_three_is_undone():
    three = Permutation(["a", "b", "c"], [1.0] * 3)
    row = three.encode({"a": 1, "b": 2, "c": 0})
    assert three.apply(torch.arange(3.0), row, STATE).tolist() == [1, 2, 0]
    box = torch.full((3,), 9.0)
    assert three.inverse(torch.tensor([1.0, 2.0, 0.0]), row, STATE, -box, box).tolist() == [0, 1, 2]


def test_a_dead_actuator_is_given_nothing():
    row = FAMILIES["dead"].encode({"v_loss": 1.0, "omega_loss": 0.5})
    assert FAMILIES["dead"].inverse(torch.ones(2), row, STATE, LOW, HIGH).tolist() == [0, 1.5]
    assert (FAMILIES["dead"].sample((50,)).sum(-1) == 1).all()


def test_a_gear_with_play_follows_a_command_that_turns_back_late():
    family = Backlash([1.0, 1.0])
    row, commands = family.encode({"backlash": 0.2}), [0.0, 0.5, 0.9, 0.8, 0.6, 0.4, 0.0]
    effects, past = [], torch.zeros(8, 2)
    for command in commands:
        now = torch.full((2,), command)
        effects.append(float(family.apply(now, row, STATE, past)[0]))
        past = torch.cat([now.unsqueeze(0), past[:-1]])
    assert effects == pytest.approx([0.0, 0.3, 0.7, 0.7, 0.7, 0.6, 0.2])


def test_a_lag_is_a_filter_of_first_order():
    family = FAMILIES["lag"]
    row, past, effects = family.encode({"lag": 2.0}), torch.zeros(8, 2), []
    for _ in range(8):
        effects.append(float(family.apply(torch.ones(2), row, STATE, past)[0]))
        past = torch.cat([torch.ones(1, 2), past[:-1]])
    assert effects == pytest.approx([1 - math.exp(-k / 2) for k in range(1, 9)])


def test_a_row_is_described_by_what_is_not_nominal(gains):
    assert gains.describe(gains.encode({})) == "nominal"
    assert gains.describe(gains.encode({"omega_gain": 0.05})) == "omega_gain = 0.05"
    whole = gains.encode({"v_gain": -1.0, "omega_gain": 2.0})
    assert gains.describe(whole.double()) == "v_gain = -1, omega_gain = 2"


@every_family
def test_values_beyond_their_limits_are_refused(family):
    for name in family.names:
        low, high = family.limits.get(name, (-math.inf, math.inf))
        for value in (low - 1, high + 1, math.nan, math.inf, "much"):
            match = rf"^regimes: {name}={re.escape(repr(value))}: expected a finite number"
            with pytest.raises(ConfigurationError, match=match):
                family.encode({name: value})


@refused(
    ("delay", {"delay": 0.5}, "delay=0.5: expected whole steps"),
    ("permutation", {"v_from": 1}, r".*expected each of 0..1 once"),
    says="^regimes: {}",
)
def test_values_that_are_no_regime_are_refused(family, values):
    FAMILIES[family].encode(values)


@refused(
    (lambda: Bias(["a"], HALF), r"names=\('a',\): expected 2 distinct names"),
    (lambda: Bias(NAMES, HALF, span=[0.4, -0.4]), r"span=\[0.4, -0.4\]: .*lower number first"),
    (lambda: Rotation([1.0]), r"half_range=\[1.0\]: expected two action axes"),
    (lambda: Rotation([1.0, 0.0]), r"action_low=0.0: expected a finite number in \(0, inf\]"),
    (lambda: Saturation(HALF, span=[0.2, 2.0]), r"span=2.0: .* in \[0.01, 1\]"),
    (lambda: DeadZone([1.0, math.inf]), "half_range, half of action_high - action_low=inf: "),
    (lambda: WheelSlip(HALF, at=[-1, 1]), "at=-1: expected"),
    (lambda: WheelSlip(HALF, peak=["a", 1]), "peak='a': expected"),
    (lambda: Patches(names=[]), r"names=\(\): expected distinct names"),
    (lambda: Delay([1, 26]), r"span=26: .* in \[1, 25\]"),
    (lambda: AsymmetricGain(["v"], span=[0.0, 1.0]), "span=0.0: expected"),
    (lambda: GainNoise(span=[-0.1, 1.0]), "span=-0.1: expected"),
    (lambda: MassFactor(span=(0.0, 1.0)), "span"),
    (lambda: MotorEfficiency(span=(0.5, 1.5)), "span"),
    (lambda: Payload(share=(-0.5, 0.5)), "share"),
    (lambda: Payload(offset=(0.01, -0.01)), "offset"),
    (lambda: Wind(span=(1.0,)), "span"),
    (lambda: ActionGain(["a", "a"]), "names"),
    (lambda: ActionGain(["a"], low=3.5), "low"),
)
def test_impossible_settings_are_refused(make):
    make()


def test_of_commands_with_random_delays_the_newest_that_has_arrived_acts():
    actuators, late = Actuators([0.0], [1.0], [400]), 3
    actuators.fail({"random_delay": late})
    sent = torch.arange(1.0, 21.0)
    acts = torch.stack([actuators(command.expand(400, 1))[:, 0] for command in sent])
    assert (acts.diff(dim=0) >= 0).all()  # none acts after a newer one
    share = [(sent[late:, None] - acts[late:] == age).double().mean() for age in range(late + 1)]
    waits = [1 - (age + 1) / (late + 1) for age in range(late + 1)]  # that one has not arrived yet
    none_newer = torch.tensor([1.0, *waits[:-1]]).cumprod(0)
    expected = none_newer * (1 - torch.tensor(waits))
    torch.testing.assert_close(torch.stack(share).float(), expected, atol=0.02, rtol=0)


def test_the_generic_search_agrees_with_the_closed_form(gains):
    low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    wanted = low + (high - low) * torch.rand(200, 2, generator=torch.Generator().manual_seed(0))
    rows = gains.sample((200,), torch.Generator().manual_seed(1))
    states = torch.zeros(200, 3)
    exact = gains.inverse(wanted, rows, states, low, high)
    before = torch.get_rng_state()
    found = gains.search(wanted, rows, states, low, high)
    assert torch.equal(torch.get_rng_state(), before)
    assert (found >= low).all() and (found <= high).all()
    torch.testing.assert_close(rows * found, rows * exact, rtol=0, atol=1e-2)


def test_the_prior_covers_what_it_says():
    family = ActionGain(["a", "b"], low=0.1, high=2.0, nominal=0.25)
    drawn = family.sample((4000, 5), torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, 5, 2)
    nominal = drawn == 1.0
    assert float(nominal.float().mean()) == pytest.approx(0.25, abs=0.01)
    changed = drawn[~nominal]
    assert changed.abs().min() >= 0.1 and changed.abs().max() <= 2.0 * (1 + 1e-6)
    assert float((changed < 0).float().mean()) == pytest.approx(0.5, abs=0.01)
    middle = math.sqrt(0.1 * 2.0)  # log-uniform: half of the gains are below
    assert float((changed.abs() < middle).float().mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("kind", [ActionGain, AsymmetricGain, Bias, DeadActuator, Saturation])
def test_there_is_a_name_or_a_half_range_for_each_action(kind, count):
    names, half = [f"axis_{k}" for k in range(count)], [1.0] * count
    settings = {Bias: (names, half), Saturation: (half,)}
    family = kind(*settings.get(kind, (names,)))
    with pytest.raises(ConfigurationError, match="the robot has 2 actions; give one n.* for each"):
        family.apply(torch.ones(4, 2), family.encode({}).expand(4, -1), torch.zeros(4, 3))
