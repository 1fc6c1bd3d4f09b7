"""Copies of parameters in another precision."""

import copy

import pytest
import torch
from torch import nn

from afm_rl.compiling.devices import CastCache


@pytest.fixture
def weights():
    """Two parameters that bfloat16 does not hold exactly."""
    return [nn.Parameter(torch.randn(4, 3)), nn.Parameter(torch.randn(4, 1, 2))]


def true_to(copies, weights):
    """Are the copies those of the present values?"""
    found = copies.of(weights)
    return all(
        torch.equal(one, weight.to(copies.dtype)) and not one.requires_grad
        for one, weight in zip(found, weights, strict=True)
    )


def replaced(weights):
    weights[0].data = weights[0].data.clone() + 1


def cut(weights):
    weights[0].data = weights[0].data[:2]  # at the same address


def turned(weights):
    weights[0].data = weights[0].data[:3].T  # the same shape and address in the end


def added(weights):
    with torch.no_grad():
        weights[1].add_(1.0)


def stepped(weights):
    weights[1].grad = torch.ones(4, 1, 2)
    torch.optim.SGD(weights, lr=1.0).step()


def dropped(weights):
    weights.pop()


@pytest.mark.parametrize("change", [replaced, cut, turned, added, stepped, dropped])
def test_every_change_is_seen(weights, change):
    copies = CastCache(torch.bfloat16)
    weights[0].data = weights[0].data[:3]
    assert true_to(copies, weights)
    change(weights)
    assert true_to(copies, weights)


def test_nothing_is_cast_twice_and_memory_serves_again(weights):
    copies = CastCache(torch.bfloat16)
    first = list(copies.of(weights))
    versions = [one._version for one in first]
    assert all(a is b for a, b in zip(copies.of(weights), first, strict=True))
    assert [one._version for one in first] == versions
    added(weights)
    assert all(a is b for a, b in zip(copies.of(weights), first, strict=True))
    assert all(one._version > version for one, version in zip(first, versions, strict=True))


def test_a_copied_model_has_copies_of_its_own(weights):
    copies = CastCache(torch.float64)
    first = copies.of(weights)
    twin = copy.deepcopy(copies)
    assert twin.dtype is torch.float64 and twin.of(weights)[0] is not first[0]
