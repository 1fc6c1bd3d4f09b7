"""The Furuta pendulum, upright when its motor fails."""

from __future__ import annotations

import numpy as np
import torch
from agents import METHODS
from faults import faults_of, regime_of
from plant import PERIOD, VOLTAGE, Plant, Simulated, step
from torch import Tensor

NAMES = {"alone": "uncorrected", "AFM": "iCEM+LQR", "truth": "truth"}
AT, STEPS, NEAR = 100, 300, 0.15  # steps; rad, as in the published protocol
PLANT = Plant(0.3, 0.03, 1)


def rewards(
    method: str, pairs: list[tuple[str, int]], steps: int | None = None
) -> tuple[dict[tuple[str, int], np.ndarray], float]:
    """Return 1 where a pendulum is up, else 0, after the fault; and seconds a step."""
    torch.manual_seed(0)
    faults, box = faults_of(1), np.array([VOLTAGE])
    pairs = [pair for pair in pairs if pair[0] in faults]
    regime = regime_of(-box, box)
    rows = torch.stack([regime.encode(faults[fault]) for fault, _ in pairs]).double()
    starts = [np.random.default_rng(seed).normal([0, np.pi, 0, 0], 0.05) for _, seed in pairs]
    world, agent = Simulated([PLANT] * len(pairs), np.array(starts)), NAMES[method]
    agent = METHODS[agent](len(pairs))
    agent.tell([PLANT] * len(pairs))
    past = torch.zeros(len(pairs), regime.history, 1, dtype=torch.float64)
    up, late = [], rows[:, list(regime.names).index("delay")].long()
    static = rows.clone()
    static[:, list(regime.names).index("delay")] = 0.0
    state = world.states
    for k in range(steps or STEPS):
        known = method == "truth" and k >= AT
        seen = _arrival(state, past, static, late, regime) if known else state
        voltages = agent.act(seen).double()
        if known:
            ends = torch.tensor([-VOLTAGE]).double(), torch.tensor([VOLTAGE]).double()
            voltages = regime.inverse(voltages, static, voltages, *ends)
        effect = regime.apply(voltages, rows, voltages, past) if k >= AT else voltages
        past = torch.cat([voltages.unsqueeze(1), past[:, :-1]], 1)
        state = world.step(effect, [0.0] * len(pairs))
        agent.learn(state)
        up.append((state[:, 1].abs() < NEAR).double().numpy())
    return dict(zip(pairs, np.stack(up[AT:], 1), strict=True)), PERIOD


def _arrival(state: Tensor, past: Tensor, static: Tensor, late: Tensor, regime) -> Tensor:
    """Return the states in which the next voltages act."""
    physics = torch.tensor([[PLANT.length, PLANT.tip]], dtype=torch.float64)
    for k in range(int(late.max()), 0, -1):  # the oldest of those under way first
        effect = regime.apply(past[:, k - 1], static, past[:, k - 1])
        state = torch.where((late >= k)[:, None], step(state, effect, physics), state)
    return state
