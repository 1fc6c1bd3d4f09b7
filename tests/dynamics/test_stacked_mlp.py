"""Stacked perceptrons against a loop over ordinary ones."""

import pytest
import torch
from torch import nn

from afm_rl.dynamics.stacked import SLOPE, stacked_mlp, stacked_mlp_tangent


def loop(weights, biases, layer_norm=False):
    networks = []
    for member in range(len(weights[0])):
        layers = []
        for weight, bias in zip(weights, biases, strict=True):
            linear = nn.Linear(*weight.shape[1:], dtype=torch.float64)
            linear.weight.data, linear.bias.data = weight[member].T, bias[member, 0]
            norm = nn.LayerNorm(weight.shape[-1], elementwise_affine=False)
            layers += [linear, *[norm] * layer_norm, nn.LeakyReLU(SLOPE)]
        networks.append(nn.Sequential(*layers[: -1 - layer_norm]))
    return networks


@pytest.fixture(params=[[3, 2], [3, 5, 2], [3, 8, 6, 2]], ids=str)
def stack(request):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    sizes = list(zip(request.param[:-1], request.param[1:], strict=True))
    return draw(4, 7, 3), [draw(4, a, b) for a, b in sizes], [draw(4, 1, b) for _, b in sizes]


def test_outputs_equal_those_of_a_loop(stack):
    inputs, weights, biases = stack
    out = stacked_mlp(inputs, weights, biases)
    for member, network in enumerate(loop(weights, biases)):
        torch.testing.assert_close(out[member], network(inputs[member]))


@pytest.mark.parametrize("layer_norm", [False, True])
def test_tangents_equal_automatic_ones(stack, layer_norm):
    inputs, weights, biases = stack
    axes = torch.eye(3, dtype=torch.float64)[1:]
    moved = stacked_mlp_tangent(inputs, axes, weights, biases, layer_norm=layer_norm)
    assert moved.shape == (4, 7, 2, 2)
    for member, network in enumerate(loop(weights, biases, layer_norm)):
        for row in range(7):
            full = torch.func.jacrev(network)(inputs[member, row])
            torch.testing.assert_close(moved[member, row], full.T[1:])


def test_gradients_equal_those_of_a_loop(stack):
    inputs, weights, biases = stack
    leaves = [part.clone().requires_grad_() for part in (*weights, *biases)]
    half = len(weights)
    stacked_mlp(inputs, leaves[:half], leaves[half:]).square().sum().backward()
    for member, network in enumerate(loop(weights, biases)):
        network(inputs[member]).square().sum().backward()
        linears = [layer for layer in network if isinstance(layer, nn.Linear)]
        for k, linear in enumerate(linears):
            torch.testing.assert_close(leaves[k].grad[member], linear.weight.grad.T)
            torch.testing.assert_close(leaves[half + k].grad[member, 0], linear.bias.grad)
