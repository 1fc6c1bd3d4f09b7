"""Online learners on the same stream of transitions: time to align, and forgetting.

    python benchmarks/bench_learners.py [--seeds 20] [--learners rls stream_x_pe online_pe]

Ground robots take smooth random actions, one robot per family of regimes and seed: 100 steps of
nominal dynamics, 200 under its regime, 100 under one of another family, 200 of nominal dynamics
again. Half-way through the first regime one transition is an outlier, 100 times as large as any
other. There is no planner: only models are compared.

A model is *aligned* from the step on after which its error is, for 20 steps in a row, below twice
the 95th percentile of its own errors in the first 100 steps (at least 0.1 mm).
"""

from __future__ import annotations

import argparse
import copy
import time

import pandas as pd
import torch
from hydra import compose, initialize_config_module
from tensordict import TensorDict
from torch import Tensor

from afm_rl.missions import build, prepare
from afm_rl.missions.build import Agent
from afm_rl.report.tables import markdown

FAMILIES = ["gains", "bias", "coupling", "dead_zone", "slip", "saturation"]
BEFORE, DURING, OTHER, AFTER, STAY = 100, 200, 100, 200, 20
NOISE, FLOOR = 1e-5, 1e-4  # m, rad
LEARNERS = {
    "rls": ["method=rls"],
    "rls_0.9": ["method=rls", "updater.forgetting=0.9"],
    "rls_0.995": ["method=rls", "updater.forgetting=0.995"],
    "stream_x_pe": ["method=stream_x_pe"],
    "online_pe": ["method=online_pe"],
}


def make(overrides: list[str], seeds: int) -> Agent:
    """Return the trained agent of the command line."""
    chosen = [f"regimes=[{','.join(FAMILIES)}]", "tracks=ethz_1", f"seeds={seeds}"]
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        cfg = compose("config", [*overrides, *chosen])
        agent = build(cfg)
    prepare(agent, cfg.cache, echo=lambda line: None)
    return agent


@torch.no_grad()
def drive(agent: Agent) -> tuple[Tensor, Tensor, float]:
    """Return errors ``(B, T)`` before each update and without any, and seconds per step."""
    draw, count = torch.Generator().manual_seed(0), len(agent.missions)
    frozen, robot = copy.deepcopy(agent.model), agent.robot
    model = agent.model.expand_(count)
    low, high = robot.action_bounds
    least, most = robot.state_bounds
    nominal = robot.regime.encode({}).expand(count, -1)
    changed = agent.missions["mission", "parameters"][:, 1]
    phases = (nominal, changed, changed.roll(count // 2, 0), nominal)
    lengths = torch.tensor([BEFORE, DURING, OTHER, AFTER])
    unit, errors, usual, spent = torch.zeros(count, len(low)), [], [], 0.0
    agent.updater.start(TensorDict({}, [count]))
    for step in range(int(lengths.sum())):
        noise = torch.randn(count, len(low) + robot.model.manifold.tangent_size, generator=draw)
        fresh, jitter = noise.split([len(low), noise.shape[1] - len(low)], -1)
        unit = (0.4 * unit + 0.6 * fresh).clamp(-1, 1)  # as the planner smooths its actions
        action = (low + high) / 2 + unit * (high - low) / 2
        state = least + (most - least) * torch.rand(count, len(least), generator=draw)
        phase = int((step >= lengths.cumsum(0)).sum())
        worth = robot.regime.apply(action, phases[phase], state)
        after = robot.model.manifold.add(robot.model(state, worth), NOISE * jitter)
        if step == BEFORE + DURING // 2:
            push = torch.nn.functional.normalize(fresh, dim=-1) * 100 * robot.env.keywords["dt"]
            after = torch.cat([after[:, :2] + push, after[:, 2:]], -1)
        for kept, each in ((errors, model), (usual, frozen)):
            kept.append(model.manifold.difference(after, each(state, action)).norm(dim=-1))
        td = TensorDict({"observation": state, "next": {"observation": after}}, [count])
        clock = time.perf_counter()
        agent.updater(td.set(agent.executed_key, action))
        spent += time.perf_counter() - clock
    return torch.stack(errors, -1), torch.stack(usual, -1), spent / len(errors)


def judge(errors: Tensor, usual: Tensor) -> pd.DataFrame:
    """Return one row per mission: measures of its errors with and without learning."""
    level = 2 * errors[:, :BEFORE].quantile(0.95, -1, keepdim=True)
    low = (errors <= level.clamp_min(FLOOR)).unfold(-1, STAY, 1).all(-1)
    middle, end = BEFORE + DURING // 2, BEFORE + DURING

    def first(start: int, stop: int) -> list[float]:
        return [float(row.int().argmax()) if row.any() else torch.inf for row in low[:, start:stop]]

    late = errors[:, -AFTER // 2 :], usual[:, -AFTER // 2 :]

    def size(part: Tensor) -> Tensor:
        return part.square().mean(-1).sqrt()

    return pd.DataFrame(
        {
            "family": [FAMILIES[k * len(FAMILIES) // len(errors)] for k in range(len(errors))],
            "nominal error": size(usual[:, :BEFORE]),
            "aligned after": first(BEFORE, middle - STAY),
            "after the outlier": first(middle + 1, end - STAY),
            "another regime": first(end, end + OTHER - STAY),
            "home after": first(end + OTHER, errors.shape[1]),
            "nominal error in the end / without learning": size(late[0]) / size(late[1]),
        }
    )


def main() -> None:
    """Print two tables: medians over all robots, and steps to alignment per family."""
    parser = argparse.ArgumentParser(description="Online learners on one stream.")
    parser.add_argument("--seeds", type=int, default=20, help="robots per family")
    parser.add_argument("--learners", nargs="*", default=list(LEARNERS), choices=list(LEARNERS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    whole, families = {}, {}
    for name in options.learners:
        errors, usual, seconds = drive(make(LEARNERS[name], options.seeds))
        rows = judge(errors, usual)
        whole[name] = rows.drop(columns="family").median()
        whole[name]["ms per update"] = 1e3 * seconds / len(rows)
        families[name] = rows.groupby("family", sort=False)["aligned after"].median()
        print(f"{name}: done", flush=True)
    for title, columns in {"medians": whole, "steps to alignment": families}.items():
        table = (
            pd.DataFrame(columns).T.map("{:.3g}".format).replace("inf", "∞").rename_axis("learner")
        )
        print(markdown(title, table.reset_index()))


if __name__ == "__main__":
    main()
