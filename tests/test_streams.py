"""Random numbers of a mission do not depend on its company."""

import math

import pytest
import torch
from fake_gpu import DEVICE, FakeGPU

from afm_rl.streams import Streams


def test_a_seed_gets_the_same_numbers_alone_as_in_any_batch():
    alone, batched = Streams(salt=1), Streams(salt=1)
    for seeds in ([7, 8, 9, 7], [9, 7], [5, 7]):  # missions come and go; 7 stays
        expected = alone.normal((4, 2), seeds=torch.tensor([7]))[0]
        together = batched.normal((4, 2), seeds=torch.tensor(seeds))
        assert together.shape == (len(seeds), 4, 2)
        for row in [i for i, seed in enumerate(seeds) if seed == 7]:
            assert torch.equal(together[row], expected)


def test_seeds_salts_and_calls_differ():
    seeds = torch.tensor([1, 2])
    one, other = Streams(salt=1), Streams(salt=2)
    rows = [*(row for streams in (one, one, other) for row in streams.normal((9,), seeds=seeds))]
    for i, left in enumerate(rows):
        for right in rows[:i]:
            assert not torch.equal(left, right)


def test_without_seeds_the_batch_draws_from_the_default_stream():
    streams = Streams(seed=4)
    drawn = streams.normal((2,), batch=(3,))
    assert drawn.shape == (3, 2) and len(drawn.unique()) == 6
    streams.manual_seed(4)
    assert torch.equal(streams.normal((2,), batch=(3,)), drawn)
    streams.manual_seed(5)
    assert not torch.equal(streams.normal((2,), batch=(3,)), drawn)


DENSITY = math.exp(-2.0) / math.sqrt(2 * math.pi)


@pytest.mark.parametrize(
    ("bound", "variance"),
    [
        (2.0, 1 - 4 * DENSITY / math.erf(math.sqrt(2))),
        (50.0, 1.0),  # beyond what float32 can tell from 1
        (None, 1.0),
    ],
)
def test_numbers_stay_in_bounds_and_have_the_right_moments(bound, variance):
    drawn = Streams().normal((200_000,), bound=bound)
    assert drawn.isfinite().all() and drawn.abs().max() <= (bound or math.inf)
    assert float(drawn.mean()) == pytest.approx(0, abs=0.01)
    assert float(drawn.var()) == pytest.approx(variance, rel=0.01)
    if bound is None:
        assert float((drawn**4).mean()) == pytest.approx(3, rel=0.05)
    assert Streams().normal((2,), dtype=torch.float64, bound=bound).dtype is torch.float64


def test_streams_continue_from_their_saved_state():
    seeds = torch.tensor([3, 1])
    streams = Streams(salt=2, seed=6)
    streams.normal((4,), seeds=seeds), streams.normal((4,))
    state = {key: value.clone() for key, value in streams.state_dict().items()}
    expected = streams.normal((4,), seeds=seeds), streams.normal((4,))
    other = Streams(salt=2)  # made with another seed; another stream has been begun
    other.normal((4,), seeds=torch.tensor([99]))
    other.load_state_dict(state)
    resumed = other.normal((4,), seeds=seeds), other.normal((4,))
    assert torch.equal(resumed[0], expected[0]) and torch.equal(resumed[1], expected[1])
    assert other.seed == 6


def test_each_device_has_a_generator_of_its_own_per_seed():
    with FakeGPU():
        streams = Streams(seed=3)
        assert streams.normal((4,)).device.type == "cpu"
        assert streams.normal((4,), device=DEVICE, bound=2.0).device == DEVICE
    assert streams.state_dict().keys() == {"seed", "3 cpu", "3 cuda:0"}


@pytest.mark.parametrize("seed", [0, 1, -1, 2**40, 2**62])
def test_any_whole_number_is_a_seed(seed):
    assert Streams(seed=seed).normal((3,)).isfinite().all()
