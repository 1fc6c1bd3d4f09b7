"""Running mean and standard deviation against those of all data at once."""

import math
from itertools import product

import pytest
import torch

from afm_rl.dynamics.stacked import LEAST_STD, RunningStats


def stream(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    data = torch.randn(*shape, generator=generator, dtype=torch.float64)
    return 1e3 + 5.0 * data  # far from zero, where naive sums of squares lose digits


@pytest.mark.parametrize(
    "pieces", [[1] * 40, [40], [1, 7, 0, 32]], ids=["one by one", "all", "mix"]
)
def test_they_are_those_of_all_samples(pieces):
    data, stats = stream(40, 3), RunningStats(3).double()
    for part in data.split(pieces):
        stats.update_(part)
    torch.testing.assert_close(stats.mean, data.mean(0))
    torch.testing.assert_close(stats.std, data.std(0))
    assert stats.count == 40
    torch.testing.assert_close(stats(data), (data - data.mean(0)) / data.std(0))


def test_streams_are_independent_and_samples_may_be_left_out():
    data, where = stream(2, 3, 30, 4), torch.rand(2, 3, 30) < 0.5
    where[0, 0] = False
    stats = RunningStats(4, lead=(2, 3)).double()
    dirty = torch.where(where.unsqueeze(-1), data, math.nan)
    for k in range(30):
        stats.update_(dirty[:, :, k], where[:, :, k])
    for at in product(range(2), range(3)):
        alone = RunningStats(4).double()
        alone.update_(data[at][where[at]])
        assert stats.count[at] == alone.count == where[at].sum()
        torch.testing.assert_close((stats.mean[at], stats.std[at]), (alone.mean, alone.std))
    whole = stats(data)
    expected = (data - stats.mean.unsqueeze(-2)) / stats.std.unsqueeze(-2)
    torch.testing.assert_close(whole, expected)
    torch.testing.assert_close(stats(data[:, :, 0]), whole[:, :, 0])


def test_they_go_on_from_where_they_are_told():
    first, second = stream(25, 2), stream(9, 2, seed=1)
    stats = RunningStats(2).double()
    stats.start_(first.mean(0), first.std(0), 25)
    stats.update_(second)
    both = torch.cat([first, second])
    torch.testing.assert_close((stats.mean, stats.std), (both.mean(0), both.std(0)))


def test_nothing_is_divided_by_zero():
    stats = RunningStats(1)
    assert torch.equal(stats(torch.tensor([3.0])), torch.tensor([3.0]))  # nothing seen
    stats.update_(torch.full((5, 1), 2.0))
    assert torch.equal(stats.std, torch.tensor([LEAST_STD]))


def test_running_statistics_go_on_from_pre_training(make_ensemble, transitions):
    model = make_ensemble(running_count=100)
    data = 2 * torch.randn(400, 4) + 1
    model.normalise_(data, torch.randn(400, 3))
    assert model.running.count == 100  # at most so many
    torch.testing.assert_close(model.running.mean, data.mean(0))
    torch.testing.assert_close(model.running.std, data.std(0))
    state, action = transitions(1)
    model.observe_(state, action)
    expected = data.mean(0) + (model.inputs(state, action)[0] - data.mean(0)) / 101
    torch.testing.assert_close(model.running.mean, expected)
    model.normalise_(data[:20], torch.randn(20, 3))
    assert model.running.count == 20


def test_statistics_stay_without_the_switch(make_ensemble, transitions):
    model = make_ensemble()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.observe_(*transitions(5))
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
