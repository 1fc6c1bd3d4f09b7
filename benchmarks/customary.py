"""The customary way to run such an agent: one mission, members one by one."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from afm_rl.dynamics import Dubins
from afm_rl.spaces.manifold import wrap_angle

TEMPERATURE, BETA = 0.001, 0.6


class Customary:
    """Plan, act and learn with plain modules, from scratch.

    Args:
        low: lowest action, ``(2,)``.
        high: highest action, ``(2,)``.
        hidden: units of the hidden layers.
        population: candidates of the planner.
        horizon: steps of a plan.
        members: networks in the ensemble.
    """

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        hidden: tuple[int, ...],
        population: int,
        horizon: int = 5,
        members: int = 5,
    ) -> None:
        self.low, self.high = low, high
        self.population, self.world = population, Dubins()
        sizes = (3, *hidden, 6)
        self.networks = []
        for _ in range(members):
            layers: list[nn.Module] = []
            for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
                layers += [nn.Linear(fan_in, fan_out), nn.LeakyReLU(0.01)]
            self.networks.append(nn.Sequential(*layers[:-1]))
        self.state, self.goal = torch.zeros(3), torch.ones(2)
        self.mean = torch.zeros(horizon, 2)

    def __call__(self) -> None:
        """Take one control step."""
        action = self.plan()
        before, self.state = self.state, self.world(self.state, 0.8 * action)
        self.learn(before, action, self.state)

    @torch.no_grad()
    def plan(self) -> Tensor:
        """Return the first action of the new mean plan."""
        shifted, past = torch.cat([self.mean[1:], self.mean[-1:]]), self.mean[0]
        raw = shifted + torch.randn(self.population, *self.mean.shape) * (self.high - self.low) / 2
        state = self.state.expand(self.population, -1)
        actions, cost = [], torch.zeros(self.population)
        for column in raw.unbind(1):
            past = (BETA * column + (1 - BETA) * past).clamp(self.low, self.high)
            actions.append(past)
            inputs = torch.cat([state[:, 2:], past], 1)
            changes = [network(inputs)[:, :3] for network in self.networks]
            state = state + torch.stack(changes).mean(0)
            state = torch.cat([state[:, :2], wrap_angle(state[:, 2:])], 1)
            cost = cost + (state[:, :2] - self.goal).norm(dim=1)
        weights = torch.softmax(-cost / TEMPERATURE, 0)
        self.mean = torch.einsum("n,nha->ha", weights, torch.stack(actions, 1))
        return self.mean[0]

    def learn(self, state: Tensor, action: Tensor, reached: Tensor) -> None:
        """Take one step of a new Adam with each member."""
        inputs, target = torch.cat([state[2:], action]).unsqueeze(0), (reached - state).unsqueeze(0)
        for network in self.networks:
            optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
            mean, log_variance = network(inputs).chunk(2, 1)
            log_variance = log_variance.clamp(-10.0, 0.5)
            loss = ((mean - target).square() * (-log_variance).exp() + log_variance).mean()
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
