"""The command ``ferry``."""

import hydra
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.envs import Compose, TransformedEnv

from afm_rl.dynamics import KnownDynamics
from afm_rl.planning import PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform
from envs import drift


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Cross the lake, planning with a propeller that turns the right way."""
    torch.manual_seed(0)
    env = instantiate(cfg.env, _convert_="all")
    low, high = env.action_spec.space.low, env.action_spec.space.high
    model = KnownDynamics(drift, Manifold(2), action_size=2)
    cost = instantiate(cfg.cost, _convert_="all")
    planner = instantiate(cfg.planner, _convert_="all")(PlanningEnv(model, cost, low, high))
    transform = ActionFlowTransform(model, enabled=cfg.correct)
    whole = TransformedEnv(env, Compose(transform, planner.make_tensordict_primer()))
    path = whole.rollout(cfg.steps, planner)
    state = "landed" if path["next", "done"][-1] else "lost"
    print(
        f"{state} after {len(path)} steps, {-path['next', 'reward'][-1].item():.2f} m from the goal"
    )
