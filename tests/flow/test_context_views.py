"""Which view of its memory a context flow believes."""

import os

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import ContextFlow, LeastSquares, Window
from afm_rl.flow.recall import Pairs, look, recall
from afm_rl.flow.views import VIEWS, lay_out

MANY, STEPS = 24, 24


def drive(effect, many=MANY, steps=STEPS, seed=0, steady=False):
    """Return states, executed actions and next states of a drive under ``effect``."""
    generator = torch.Generator().manual_seed(seed)
    unit = 2 * torch.rand(many, steps, 2, generator=generator) - 1
    if steady:
        unit = 0.75 + 0.25 * unit
    executed = unit * torch.tensor([1.0, 1.5])
    states = [torch.zeros(many, 3)]
    for k in range(1, steps + 1):
        so_far = executed[:, :k], torch.stack(states, -2)
        states.append(Dubins()(states[-1], effect(*so_far, generator)[:, -1]))
    state = torch.stack(states, -2)
    return state[:, :-1], executed, state[:, 1:]


def late(executed, state, generator):
    return executed.roll(1, -2)


def patchy(executed, state, generator):
    return torch.where((state[..., :1] / 0.4).floor() % 2 == 0, -executed, executed)  # stripes


def noisy(executed, state, generator):
    return executed * (1 + 0.4 * torch.randn(executed.shape, generator=generator))


def turned_and_noisy(executed, state, generator):
    return executed * (-1 + 0.5 * torch.randn(executed.shape, generator=generator))


def changing(executed, state, generator):
    then = torch.arange(executed.shape[-2]).unsqueeze(-1) < STEPS - 2  # but the last two
    return torch.where(then, executed, -executed)


def reversed_(executed, state, generator):
    return -executed


def shares(flow, contexts):
    """Return the share of missions and steps that believed each view: the least evidence."""
    evidence = torch.stack([context.evidence + flow.doubt for context in contexts])
    best = evidence.argmin(-1).flatten()
    counts = torch.bincount(best, minlength=len(flow.views)) / len(best)
    return dict(zip(flow.views, counts.tolist(), strict=True))


ALL = list(VIEWS)
BY_TIME = [name for name, view in VIEWS.items() if not view.near]


@pytest.mark.parametrize(
    ("regime", "view", "among", "steps", "forgetting"),
    [
        (late, "late_1", ALL, (10, STEPS), 0.9),
        (
            patchy,
            "near",
            ["silent", "recent", "long", "late_1", "near"],
            (14, STEPS),
            0.9,
        ),
        (turned_and_noisy, "mean", ["silent", "recent", "newest", "mean", "late_1"], (50, 60), 1.0),
        (changing, "newest", BY_TIME, (STEPS - 1, STEPS), 0.9),
        (reversed_, "recent", ["silent", "recent", "late_1", "late_2", "near"], (4, STEPS), 0.9),
        (noisy, "silent", ["silent", "recent", "newest", "late_1", "near"], (8, STEPS), 0.9),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_the_view_made_for_a_regime_is_believed(
    fitted, live, regime, view, among, steps, forgetting
):
    settings = {
        "window": 6,
        "memory": 13,
        "place": [0],
        "place_scale": 0.1,
        "forgetting": forgetting,
    }
    flow, steady = fitted(views=among, **settings), regime is turned_and_noisy
    found = live(flow, *drive(regime, steps=steps[1], steady=steady))[steps[0] :]
    share = shares(flow, found)
    assert max(share, key=share.get) == view and share[view] > 0.6, share


def test_what_is_believed_decides(fitted, live):
    flow = fitted(views=["recent", "late_1"], forgetting=0.9)
    found = live(flow, *drive(late))[-1]
    believed = found.evidence.argmin(-1) == 1
    assert believed.float().mean() > 0.8
    planned = torch.tensor([0.3, -0.5]).expand(MANY, 2)
    corrected = flow.correct(found, None, planned).action
    for k, name in enumerate(flow.views):
        size = flow.action_size
        pairs = Pairs(*found.pairs[..., :-1].split([size, size, 1], -1))
        features = look(pairs, lay_out([VIEWS[name]], flow.shown)).squeeze(-2)
        alone = flow.correct(flow.told(features), None, planned).action
        chosen = found.evidence.argmin(-1) == k
        torch.testing.assert_close(corrected[chosen], alone[chosen])


def test_noise_is_left_alone_and_a_reversed_motor_is_not(fitted, live):
    flow = fitted(views=["silent", "recent", "late_1"], forgetting=0.9)
    for regime, corrected in ((noisy, (0.0, 0.3)), (reversed_, (0.99, 1.0))):
        found = live(flow, *drive(regime))[6:]
        assert all((context.surprise > flow.gate).all() for context in found)
        share = float(torch.stack([context.misaligned for context in found]).float().mean())
        assert corrected[0] <= share <= corrected[1]
    loud = fitted(views=["recent", "late_1"], forgetting=0.9)
    assert all(context.misaligned.all() for context in live(loud, *drive(noisy))[6:])


def test_evidence_is_the_forgetting_sum_of_bounded_losses(fitted, live):
    flow = fitted(views=["silent", "recent"], forgetting=0.5)
    found = live(flow, *drive(reversed_))
    for before, after in zip(found[4:-1], found[5:], strict=True):
        loss = after.evidence - 0.5 * before.evidence
        executed, effective = after.pairs[:, -1, :2], after.pairs[:, -1, 2:4]
        miss = (executed - effective).square()
        expected = (miss / (miss + 0.25**2)).mean(-1)
        torch.testing.assert_close(loss[:, 0], expected, rtol=1e-4, atol=1e-5)
        assert (loss >= -1e-6).all() and (loss <= 1).all()


def test_evidence_fades_where_nothing_surprises(fitted, live):
    flow = fitted(forgetting=0.5)
    aligned = live(flow, *drive(lambda executed, state, generator: executed))
    assert not any(context.evidence.any() for context in aligned)
    window, last = _window_of_last(flow), live(flow, *drive(reversed_))[-1]
    quiet = flow.context(window, Dubins(), last._replace(pairs=torch.zeros_like(last.pairs)))
    torch.testing.assert_close(quiet.evidence, 0.5 * last.evidence)
    assert not quiet.features.any() and not quiet.misaligned.any()


def _window_of_last(flow):
    state, executed, _ = drive(reversed_, steps=flow.window)
    valid = torch.ones(MANY, flow.window, dtype=torch.bool)
    return Window(state, executed, executed, Dubins()(state, executed), valid)


def test_a_mission_finds_the_same_alone_as_in_company(live, box):
    flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, place=[0, 1])
    parts = [drive(regime, many=2) for regime in (late, patchy, noisy, reversed_)]
    parts.append(drive(lambda executed, state, generator: executed, many=2))  # no surprise
    rows = [torch.cat(part) for part in zip(*parts, strict=True)]
    valid = torch.rand(10, STEPS, generator=torch.Generator().manual_seed(1)) < 0.9
    together = live(flow, *rows, valid=valid)
    for k in range(10):
        alone = live(flow, *(part[k] for part in rows), valid=valid[k])
        for found, expected in zip(alone, together, strict=True):
            for one, other in zip(found, expected, strict=True):
                torch.testing.assert_close(one, other[k], rtol=1e-4, atol=1e-5)


def test_nothing_is_learnt_from_a_transition_that_does_not_count(flow, live):
    rows = drive(reversed_)
    valid = torch.ones(MANY, STEPS, dtype=torch.bool)
    valid[:, -1] = False
    before, after = live(flow, *rows, valid=valid)[-2:]
    torch.testing.assert_close(after.evidence, flow.forgetting * before.evidence)


class Asked(Dubins):
    """Counts the transitions that it is asked about."""

    def forecast(self, state, action):
        self.count = state.shape[-2]
        return super().forecast(state, action)


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("kind", ["context", "least squares"])
def test_a_model_is_asked_again_only_where_it_learns(flow, box, window_of, learns, kind):
    corrector, model = flow if kind == "context" else LeastSquares(*box, window=9), Asked()
    assert corrector.fresh == (4 if kind == "context" else 9)
    model.taught_in = os.getpid() if learns else None
    window = window_of([-1.0, 1.0], 3)
    first = corrector.context(window, model)
    assert model.count == 9
    after = corrector.context(window, model, first)
    count = corrector.fresh if learns else 1
    assert model.count == count
    kept = after.pairs[:, : 9 - count]
    assert torch.equal(kept, first.pairs[:, 1 : 10 - count])  # older answers stand, one row on
    assert torch.equal(after.pairs[:, 9 - count :], first.pairs[:, 9 - count :])


def test_cached_pairs_equal_those_judged_anew(flow, live):
    state, executed, next_state = drive(patchy)
    kept = live(flow, state, executed, next_state)[-1]
    rows = (part[:, -flow.window :] for part in (state, executed, next_state))
    anew = flow.judge(Dubins(), *rows, torch.ones(MANY, flow.window).bool())
    torch.testing.assert_close(kept.pairs, anew)


def test_what_a_model_has_learnt_meanwhile_is_told(flow, live):
    model = Dubins()
    rows = drive(reversed_)
    last = live(flow, *rows, model=model)[-1]
    window = _window_of_last(flow)._replace(next_state=Dubins()(rows[0], -rows[1])[:, -9:])
    window = window._replace(state=rows[0][:, -9:], executed=rows[1][:, -9:])
    model.step = lambda state, action: Dubins()(state, -action)  # it has understood
    model.jacobian = lambda state, action: -Dubins().jacobian(state, action)
    stubborn = flow.context(window, model, last)
    assert stubborn.misaligned.any()
    model.taught_in = os.getpid()
    assert not flow.context(window, model, last).misaligned.any()


@pytest.mark.parametrize(
    ("settings", "least"),
    [
        ({}, 8),
        ({"views": ["recent"]}, 4),
        ({"views": ["late_2", "silent"]}, 6),
        ({"window": 12}, 24),
    ],
    ids=str,
)
def test_a_memory_must_hold_what_views_read(box, settings, least):
    small = {"window": 4, "hidden": [8], "latent": 4, **settings}
    ContextFlow(*box, memory=least, **small)
    complaint = f"corrector.memory={least - 1}: .* at least {least} "
    with pytest.raises(ConfigurationError, match=complaint):
        ContextFlow(*box, memory=least - 1, **small)


@pytest.mark.parametrize("views", ["recent", [], 3, None, ["recent", "sideways"], ["silent"]])
def test_unknown_views_are_refused(box, views):
    with pytest.raises(ConfigurationError, match="corrector.views="):
        ContextFlow(*box, views=views)


def test_views_by_place_need_a_place(box):
    some = ["silent", "near", "recent", "nearest"]
    assert ContextFlow(*box, views=some).views == ["silent", "recent"]
    assert ContextFlow(*box, views=some, place=[0, 1]).views == some
    assert ContextFlow(*box, views=some).evidence_size == 2
    with pytest.raises(ConfigurationError, match="robot.place for views by place"):
        ContextFlow(*box, views=["near", "silent"])


def test_distances_are_in_units_of_the_scale():
    state = torch.tensor([[[2.0, 0.0, 9.0], [2.0, 4.0, 0.0]]])
    memory = recall(torch.zeros(1, 2, 6), state, torch.zeros(1, 2, 3), [0, 1], 2.0)
    assert memory.away.tolist() == [[1.0, 5.0]]  # from where it came to
