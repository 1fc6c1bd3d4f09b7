"""Effect of the published update on an ensemble of two, and of three hidden layers.

    python benchmarks/bench_layers.py

Both are pre-trained as in agent=paper, and learn from a robot whose speed is reversed, one
transition per step, with random headings and actions, so what the ensemble learns at one heading
must hold at the others. It prints the root mean square error of the change of x on held-out
transitions, in standard deviations of the training data: the mean over learners, with a 95 %
interval.
"""

from __future__ import annotations

import pandas as pd
import torch
from hydra import compose, initialize_config_module
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.missions import build, prepare
from afm_rl.missions.build import Agent
from afm_rl.report.statistics import estimate
from afm_rl.report.tables import interval_text, markdown

LAYERS = {"two": [200, 200], "three": [200, 200, 200]}
REVERSED = torch.tensor([-1.0, 1.0])
UPDATES, LEARNERS, HELD_OUT = (0, 200, 400), 8, 1000


def pretrained(*choices: str) -> Agent:
    """Return a learner of the paper with these settings."""
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        cfg = compose("config", ["agent=paper", *choices])
        agent = build(cfg)
    prepare(agent, cfg.cache, echo=lambda line: None)
    return agent


def transitions(agent: Agent, *batch: int) -> TensorDict:
    """Return transitions ``(*batch)`` of the reversed robot, from random headings and actions."""
    low, high = agent.robot.action_bounds
    heading = torch.pi * (2 * torch.rand(*batch, 1) - 1)
    state = torch.cat([torch.zeros(*batch, 2), heading], -1)
    action = low + (high - low) * torch.rand(*batch, len(low))
    reached = {"observation": Dubins()(state, REVERSED * action)}
    seen = TensorDict({"observation": state, "next": reached}, batch)
    return seen.set(agent.executed_key, action)


@torch.no_grad()
def errors(agent: Agent) -> dict[str, str]:
    """Return the error after each number of updates, as text."""
    torch.manual_seed(0)
    model, texts = agent.model.expand_(LEARNERS), {}
    held_out = transitions(agent, LEARNERS, HELD_OUT)
    for update in range(max(UPDATES) + 1):
        if update in UPDATES:
            expected, _ = model.forecast(held_out["observation"], held_out[agent.executed_key])
            missed = (held_out["next", "observation"] - expected)[..., 0] / model.target_std[0]
            values = pd.Series(missed.square().mean(-1).sqrt().tolist())
            means = estimate("error", values, pd.Series("all", values.index))
            texts[f"after {update}"] = interval_text(means, "error", 2)
        agent.updater(transitions(agent, LEARNERS))
    return texts


if __name__ == "__main__":
    rows = []
    for name, hidden in LAYERS.items():
        agent = pretrained("method=online_pe", f"dynamics.hidden={hidden}")
        rows.append({"hidden layers": name} | errors(agent))
    print(markdown("error of the change of x", pd.DataFrame(rows)))
