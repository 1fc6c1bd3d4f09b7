"""The guard: whatever planner, policy or corrector answer, the environment gets safe actions."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torchrl.envs import Compose, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import KnownDynamics
from afm_rl.envs import CrazyflieTrack, UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import Guard

BAD = [math.nan, math.inf, -math.inf, 1e30, -1e30, 3.0, -3.0, 0.5]
MISSIONS = 6


class Readings(Transform):
    """A sensor that gives anything instead of an entry."""

    def __init__(self, change, key="observation"):
        super().__init__(in_keys=[key])
        self.change, self.key = change, key

    def _step(self, tensordict, next_tensordict):
        seen = self.change(int(next_tensordict["step"][0]), next_tensordict[self.key].clone())
        return next_tensordict.set(self.key, seen)

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def drive(base, chain, actions):
    env, rows = TransformedEnv(base, Compose(*chain)), []
    td = env.reset()
    for action in actions:
        td["action"] = torch.as_tensor(action).expand(base.action_spec.shape).clone()
        td = env.step(td)
        rows.append(td["next"])
        td = step_mdp(td)
    return rows


@pytest.mark.parametrize("make", [UGVTrack, CrazyflieTrack], ids=["ugv", "quadrotor"])
@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_answer_becomes_a_safe_action(make, data):
    base = make(batch_size=(MISSIONS,))
    size, spec = base.action_spec.shape, base.action_spec
    numbers = st.one_of(st.sampled_from(BAD), st.floats(width=32))
    lists = st.lists(numbers, min_size=size.numel(), max_size=size.numel())
    answers = [torch.tensor(data.draw(lists)).reshape(size) for _ in range(4)]
    given, step = [], base._step

    def watched(td):
        given.append(td["action"].clone())
        return step(td)

    base._step = watched
    rows = drive(base, [Guard()], answers)
    last = spec.zero().clamp(spec.space.low, spec.space.high)
    for passed, answer, row in zip(given, answers, rows, strict=True):
        assert spec.is_in(passed) and passed.isfinite().all()
        held = ~answer.isfinite().all(-1)
        assert torch.equal(row["guard", "held"], held)
        assert torch.equal(passed[held], last[held])
        assert torch.equal(row["guard", "executed_action"], passed)
        last = passed


@pytest.mark.parametrize("box", [(0.5, 2.0), (-2.0, -0.5)])
def test_what_cannot_be_executed_at_first_becomes_the_action_nearest_to_zero(box):
    push = KnownDynamics(lambda state, action: state + action, Manifold(1), 1)
    base = PlanningEnv(push, KnownReward(lambda state, action, after: after[..., 0]), *zip(box))
    assert TransformedEnv(base, Guard()).reset()["guard", "executed_action"] == min(box, key=abs)
    (row,) = drive(base, [Guard()], [math.nan])
    assert row["guard", "executed_action"] == min(box, key=abs) and row["guard", "held"]


def test_one_frozen_sensor_among_others():
    def freeze(step, seen):
        if step == 4:
            freeze.kept = seen[2].clone()
        if 4 < step < 10:
            seen[2] = freeze.kept
        return seen

    rows = drive(UGVTrack(batch_size=(4,)), [Readings(freeze), Guard()], [0.3] * 14)
    sound = torch.stack([row["guard", "sound"] for row in rows], 1)
    assert sound[[0, 1, 3]].all()
    assert (~sound[2]).nonzero().flatten().tolist() == [4, 5, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda seen: seen[..., :2], "'observation': torch.float32 .4, 2., expected .* .4, 3."),
        (lambda seen: seen > 0, "'observation': torch.bool"),
    ],
)
def test_a_malformed_reading_is_named_and_is_no_reading(wrong, words):
    chain = [Readings(lambda step, seen: wrong(seen) if step == 3 else seen), Guard()]
    with pytest.warns(UserWarning, match=words):
        rows = drive(UGVTrack(batch_size=(4,)), chain, [0.3] * 6)
    sound = torch.stack([row["guard", "sound"] for row in rows], 1)
    assert sound.tolist() == [[True, True, False, False, True, True]] * 4
    assert rows[2]["observation"].isnan().all() and rows[2]["observation"].shape == (4, 3)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64])
def test_a_reading_of_another_type_is_converted(kind):
    chain = [Readings(lambda _, seen: seen.to(kind)), Guard()]
    rows = drive(UGVTrack(batch_size=(4,)), chain, [0.0] * 3)
    assert all(row["observation"].dtype == torch.float32 for row in rows[1:])
    assert rows[2]["guard", "reading"].equal(rows[2]["observation"].to(kind).float())


def test_a_time_stamp_that_stands_still():
    guard, base = Guard(stamp_key="step"), CrazyflieTrack(batch_size=(2,))
    rows = drive(base, [guard], [0.1] * 5)
    assert all(row["guard", "sound"].all() for row in rows)
    stops = Readings(lambda _, step: step.clamp(max=3), "step")
    rows = drive(base, [stops, Guard(stamp_key="step")], [0.1] * 5)
    assert [bool(row["guard", "sound"].all()) for row in rows] == [True] * 3 + [False] * 2
    stopped = Guard(stamp_key="since", patience=1)  # stands still until the phase changes
    assert not any(row["guard", "sound"].any() for row in drive(base, [stopped], [0.0] * 3))


def test_an_action_of_another_shape_is_refused():
    env = TransformedEnv(UGVTrack(batch_size=(4,)), Compose(Guard()))
    td = env.reset().set("action", torch.zeros(4, 3))
    with pytest.raises(ConfigurationError, match=r"\(4, 3\), expected real numbers \(4, 2\)"):
        env.step(td)
