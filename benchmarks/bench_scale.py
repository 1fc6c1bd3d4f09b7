"""What a control step costs against missions, candidates, ensemble members and pairs; a figure.

    python benchmarks/bench_scale.py [--out FILE.csv] [--figure FILE.png]

A step plans (MPPI, horizon 5), corrects (AFM), acts and remembers; over an ensemble of 200 x 200 x
200 units it also learns, with weights per mission. The motors are reversed, so that the correction
is at work. Processor time of one thread. Unless the table says otherwise: 10 missions in a batch,
200 candidates, five members, 12 pairs that a hypothesis reads.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median

import matplotlib.pyplot as plt
import pandas as pd
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from timing import timed
from torchrl.envs import Compose
from torchrl.envs.utils import step_mdp

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins, Ensemble
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.storage.files import write_whole
from afm_rl.transforms import ActionFlowPolicy

LOW, HIGH, HIDDEN = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57]), (200, 200, 200)
USUAL = {"missions": 10, "candidates": 200, "members": 5, "pairs": 12}
CASES = {
    "physics": {
        "missions": (1, 10, 100, 1000),
        "candidates": (100, 200, 400, 1000, 3000),
        "pairs": (12, 24, 48, 96),
    },
    "ensemble": {
        "missions": (1, 10, 100),
        "candidates": (100, 200, 400, 1000),
        "members": (1, 2, 5, 10),
        "pairs": (12, 24, 48, 96),
    },
}
STEPS = 700  # of a mission of the ground robot, about


class Batch:
    """Missions side by side."""

    def __init__(self, kind: str, missions: int, candidates: int, members: int, pairs: int) -> None:
        model, self.updater = Dubins(), None
        if kind == "ensemble":
            shape = {"members": members, "hidden": HIDDEN, "propagation": "member"}
            model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], **shape).expand_(missions)
            self.updater = OnlineUpdater(GaussianNLLLoss(model), ResetAdam)
        world = PlanningEnv(model, GoalDistance(), LOW, HIGH)
        planner = MPPI(world, horizon=5, population=candidates, seed_key="seed")
        flow = ActionFlow(LOW, HIGH, rows=pairs, memory=max(40, 3 * pairs), quiet=0.0, odds=0.0)
        self.agent = TensorDictSequential(
            planner, ActionFlowPolicy(model, planner.action_spec, flow)
        )
        start = TensorDict(
            {
                "observation": torch.zeros(missions, 3),
                "goal": torch.full((missions, 2), 1e3),  # so far that nobody arrives
                "seed": torch.arange(missions),
            },
            [missions],
        )
        self.td = Compose(*(part.make_tensordict_primer() for part in self.agent))(start)
        self.robot = Dubins()

    @torch.no_grad()
    def __call__(self) -> None:
        """Take one control step with each mission."""
        td = self.agent(self.td)
        later = self.robot(td["observation"], -0.8 * td["action"])
        td["next", "observation"] = later
        if self.updater is not None:
            self.updater(td)
        keep = {name: td[name] for name in ("goal", "seed")}
        self.td = step_mdp(td).update(keep)


def measure(rounds: int) -> pd.DataFrame:
    """Return a row per case: milliseconds of a step of one mission, and missions per hour."""
    rows = []
    for kind, varied in CASES.items():
        for name, values in varied.items():
            for value in values:
                settings = USUAL | {name: value}
                job = Batch(kind, **settings)
                spent = timed({"": job}, rounds, clock=time.thread_time)[""]
                ms = median(spent) / settings["missions"]
                rate = 3.6e6 / (STEPS * ms)
                rows.append({"model": kind, "varied": name, **settings, "ms": ms, "per_hour": rate})
                print(f"{kind:10}{name:12}{value:6}{ms:10.3f}{rate:12.0f}", flush=True)
    return pd.DataFrame(rows)


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draw a panel per quantity that was varied."""
    names = {
        "missions": "missions in a batch",
        "candidates": "candidates of MPPI",
        "members": "members of the ensemble",
        "pairs": "pairs that a hypothesis reads",
    }
    figure, axes = plt.subplots(1, 4, figsize=(11, 2.8), sharey=True, layout="constrained")
    for axis, (name, label) in zip(axes, names.items(), strict=True):
        for kind, mark in (("physics", "o-"), ("ensemble", "s-")):
            rows = table[(table["model"] == kind) & (table["varied"] == name)]
            axis.loglog(rows[name], rows["ms"], mark, label=kind)
        ticks = sorted(set(table[table["varied"] == name][name]))
        axis.set_xticks(ticks, ticks)
        axis.set_yticks([1, 2, 5, 10, 20], [1, 2, 5, 10, 20])
        axis.minorticks_off()
        axis.set(xlabel=label)
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="ms per step of a mission")
    axes[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print a table, write it, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("outputs/scale.csv"))
    parser.add_argument("--figure", type=Path, default=Path("outputs/scale.png"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(f"{'model':10}{'varied':12}{'':6}{'ms / step':>10}{'missions/h':>12}")
    write_whole(options.out, measure(options.rounds).to_csv(index=False).encode())
    draw(pd.read_csv(options.out), options.figure)


if __name__ == "__main__":
    main()
