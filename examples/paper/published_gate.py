"""The effect of the published flow on actions: both sides of eq. 14, and the share of open gates.

    python examples/paper/published_gate.py --figure docs/images/paper_gate.png  # over Dubins
    python examples/paper/published_gate.py outputs/paper/gate/jobs/*            # in missions

Without folders it trains the published flow over the nominal model, and draws states and actions
under each regime of the paper at the moment of the change, when the model is still the nominal one.
With a the planned action, T the regime, f the nominal model, eq. 14 says that the executed action b
is no farther from the planned state than a: ``|f(s, T b) - f(s, a)| <= |f(s, T a) - f(s, a)|``.
With folders of runs it prints the share of actions that were transformed while a regime acted.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from published_tables import HEADS, published
from torch import Tensor

from afm_rl.correction import PaperFlow
from afm_rl.correction.training import train_flow
from afm_rl.dynamics import Dubins
from afm_rl.report import read_runs, style
from afm_rl.report.tables import markdown
from afm_rl.spaces.manifold import uniform
from afm_rl.storage.files import write_whole

HIGH = torch.tensor([1.0, torch.pi / 2])  # m/s, rad/s
STATES = torch.tensor([-10.0, -10.0, -torch.pi]), torch.tensor([10.0, 10.0, torch.pi])
GATE = 1.0
DRAWS = 4096


def trained_flow(iterations: int) -> PaperFlow:
    """Return the published flow over the nominal model."""
    flow = PaperFlow(-HIGH, HIGH, features=[2], state_size=3)
    error = train_flow(flow, Dubins(), STATES, iterations=iterations, batch_size=256, lr=1e-2)
    print(f"error of the flow: {error:.3f}")
    return flow


def miss(action: Tensor, state: Tensor, planned: Tensor, gains: Tensor) -> Tensor:
    """Return how far the changed robot lands from the planned state ``(N,)``, m and rad mixed."""
    model = Dubins()
    reached = model(state, action * gains)
    return model.manifold.difference(reached, model(state, planned)).norm(dim=-1)


@torch.no_grad()
def sides(flow: PaperFlow, gains: Tensor, seed: int = 0) -> dict[str, float]:
    """Return the means of both sides of eq. 14 under one regime, and the errors at the gate.

    Args:
        flow: trained.
        gains: of v and omega, ``(2,)``.
        seed: of states and actions.
    """
    generator, model = torch.Generator().manual_seed(seed), Dubins()
    state = uniform(*STATES, DRAWS, generator)
    before, planned = (uniform(-HIGH, HIGH, DRAWS, generator) for _ in range(2))
    after, expected = model(state, before * gains), model(state, before)
    error = after - expected  # as published: headings are not wrapped
    kept = torch.cat([state[:, 2:], before, error], -1)
    action = flow._integrate(kept, planned).clamp(-HIGH, HIGH)
    explaining = (planned * gains).clamp(-HIGH, HIGH)
    right = miss(planned, after, planned, gains)
    left = miss(action, after, planned, gains)
    ideal = miss(explaining, after, planned, gains)
    wrapped = model.manifold.difference(after, expected).norm(dim=-1)
    return {
        "opens": (error.norm(dim=-1) >= GATE).double().mean().item(),
        "opens, wrapped": (wrapped >= GATE).double().mean().item(),
        "right": right.mean().item(),
        "left": left.mean().item(),
        "holds": (left <= right).double().mean().item(),
        "ideal": ideal.mean().item(),
        "ideal holds": (ideal <= right).double().mean().item(),
    }


def flow_table(iterations: int) -> pd.DataFrame:
    """Return a row for each regime of the paper: both sides of eq. 14 at the change."""
    flow = trained_flow(iterations)
    rows = []
    for gains in published()[["v_gain", "omega_gain"]].drop_duplicates().to_numpy():
        found = sides(flow, torch.tensor(gains, dtype=torch.float32))
        rows.append(
            {
                "regime": "{:g}, {:g}".format(*gains),
                "gate opens (%)": f"{100 * found['opens']:.1f}",
                "with wrapped angles (%)": f"{100 * found['opens, wrapped']:.1f}",
                "plan executed": f"{found['right']:.3f}",
                "flow executed": f"{found['left']:.3f}",
                "eq. 14 holds (%)": f"{100 * found['holds']:.0f}",
                "exact explanation executed": f"{found['ideal']:.3f}",
                "eq. 14 holds for it (%)": f"{100 * found['ideal holds']:.0f}",
            }
        )
    return pd.DataFrame(rows)


def draw(table: pd.DataFrame) -> Figure:
    """Return both sides of eq. 14, and in how many cases it holds, a row per regime."""
    figure, place = style.new_figure(9.0, 3.8), np.arange(len(table))[::-1]
    miss, holds = figure.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    shown = [  # legend, colour, column of the distance, column of the share
        ("plan executed (right side)", "0.6", "plan executed", None),
        ("flow executed (left side)", "#d55e00", "flow executed", "eq. 14 holds (%)"),
        ("exact explanation", "#0072b2", "exact explanation executed", "eq. 14 holds for it (%)"),
    ]
    for offset, (name, color, column, share) in zip((0.25, 0, -0.25), shown, strict=True):
        miss.barh(place + offset, table[column].astype(float), 0.22, color=color, label=name)
        if share is not None:
            holds.barh(place + offset, table[share].astype(float), 0.22, color=color)
    miss.set_yticks(place, table["regime"], fontsize=style.SMALL)
    style.dress(miss, "distance from the planned state", "gains of v, omega", "x")
    style.dress(holds, "cases in which eq. 14 holds (%)", "", "x")
    holds.set_xlim(0, 100)
    style.legend_above(figure, *miss.get_legend_handles_labels())
    return figure


def mission_table(folders: list[Path]) -> pd.DataFrame:
    """Return the share of actions that were transformed under each regime, a column a run."""
    shown: dict[str, dict[str, str]] = {}
    for folder in folders:
        runs = read_runs([folder])
        steps = runs.steps(columns=["corrected", "regime_active"])
        steps = steps[steps["regime_active"] == 1].merge(runs.missions, on="mission")
        for (method, regime), group in steps.groupby(["method", "regime"], sort=False):
            head = f"{HEADS.get(method, method)}, {folder.name}"
            shown.setdefault(regime, {})[head] = f"{100 * group['corrected'].mean():.1f}"
    return pd.DataFrame(shown).T.fillna("-").rename_axis("regime").reset_index()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, help="results of runs with the flow")
    parser.add_argument("--iterations", type=int, default=8000, help="of training the flow")
    parser.add_argument("--figure", type=Path, help="PNG file for both sides of eq. 14")
    options = parser.parse_args()
    if options.folders:
        print(markdown("transformed actions (%)", mission_table(options.folders)))
    else:
        table = flow_table(options.iterations)
        print(markdown("both sides of eq. 14", table))
        if options.figure:
            write_whole(options.figure, style.png_bytes(draw(table)))
