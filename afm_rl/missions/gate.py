"""The gate of an agent's corrector, fitted over a learned model."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from afm_rl.correction import PaperFlow
from afm_rl.dynamics import DynamicsModel
from afm_rl.learning import fit_gate
from afm_rl.missions.build import Agent
from afm_rl.missions.collected import transitions
from afm_rl.spaces.sampling import uniform

TRANSITIONS = 20_000
EPISODE = 800  # transitions under the planner


@torch.no_grad()
def fit_agents_gate(agent: Agent) -> float | None:
    """Fit the gate to ``false_alarms`` on fresh transitions of the nominal robot; return it.

    States and actions are drawn from the boxes of the pre-training; a robot that collects its data
    is planned for, as in missions.

    Returns:
        The gate, or None where it stays as it was set: without a corrector, over equations, for
        the published corrector, whose gate is in other units, and with ``false_alarms=null``.
    """
    rate, transform = agent.settings["false_alarms"], agent.transform
    learned = any(isinstance(part.module, DynamicsModel) for part in agent.trainings)
    if rate is None or transform is None or not learned:
        return None
    if isinstance(transform.corrector, PaperFlow):
        return None
    if agent.robot.data is not None:
        healthy = transitions(agent.robot, EPISODE, agent.robot.data.seed + 1000, agent.planner)
        return fit_gate(transform.corrector, agent.model, healthy, rate)
    robot, generator = agent.robot, torch.Generator().manual_seed(1)
    state, action = (
        uniform(*box, TRANSITIONS, generator).to(agent.device)
        for box in (robot.state_box, robot.action_box)
    )
    state = robot.model.manifold.project(state)
    healthy = TensorDict({"observation": state, "action": action}, [TRANSITIONS])
    healthy.set(("next", "observation"), robot.model(state, action))
    return fit_gate(transform.corrector, agent.model, healthy, rate)
