"""The Furuta pendulum, upright when its motor fails."""

from __future__ import annotations

import numpy as np
import torch
from agents import METHODS
from plant import PERIOD, VOLTAGE, Plant, Simulated, step
from torch import Tensor

from afm_rl.regimes import Actuators, presets

NAMES = {"alone": "uncorrected", "AFM": "iCEM+LQR", "truth": "truth"}
AT, STEPS, NEAR = 100, 300, 0.15  # steps; rad, as in the published protocol
PLANT = Plant(0.3, 0.03, 1)


def rewards(
    method: str, pairs: list[tuple[str, int]], steps: int | None = None
) -> tuple[dict[tuple[str, int], np.ndarray], float]:
    """Return 1 where a pendulum is up, else 0, after the fault; and seconds a step."""
    torch.manual_seed(0)
    faults = presets(1)
    pairs = [pair for pair in pairs if pair[0] in faults]
    actuators = Actuators([-VOLTAGE], [VOLTAGE], [len(pairs)])
    starts = [np.random.default_rng(seed).normal([0, np.pi, 0, 0], 0.05) for _, seed in pairs]
    world, agent = Simulated([PLANT] * len(pairs), np.array(starts)), NAMES[method]
    agent = METHODS[agent](len(pairs))
    agent.inform([PLANT] * len(pairs))
    own = [faults[fault] for fault, _ in pairs]
    up = []
    state = world.states
    for k in range(steps or STEPS):
        if k == AT:
            actuators.fail(*own)
        known = method == "truth" and k >= AT
        seen = _arrival(state, actuators) if known else state
        voltages = agent.act(seen).double()
        if known:
            box = actuators.low, actuators.high
            voltages = actuators.regime.inverse(voltages, actuators.memoryless, voltages, *box)
        state = world.step(actuators(voltages), [0.0] * len(pairs))
        agent.learn(state)
        up.append((state[:, 1].abs() < NEAR).double().numpy())
    return dict(zip(pairs, np.stack(up[AT:], 1), strict=True)), PERIOD


def _arrival(state: Tensor, actuators: Actuators) -> Tensor:
    """Return the states in which the next voltages act."""
    physics = torch.tensor([[PLANT.length, PLANT.tip]], dtype=torch.float64)
    delay = actuators.value("delay").long()
    for k in range(int(delay.max()), 0, -1):  # the oldest of those under way first
        pending = actuators.past[:, k - 1]
        effect = actuators.regime.apply(pending, actuators.memoryless, pending)
        state = torch.where((delay >= k)[:, None], step(state, effect, physics), state)
    return state
