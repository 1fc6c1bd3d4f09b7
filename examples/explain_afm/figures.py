"""Draw the figures of docs/afm.md.

Run ``python examples/explain_afm/figures.py --out docs/images``.
The first run trains the published flow (some minutes); it is kept in the cache of ``afm-rl``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from hydra import compose, initialize_config_module
from matplotlib.axes import Axes

from afm_rl.missions import Agent, build, prepare, run
from afm_rl.report.style import dress, method_styles, new_figure, png_bytes
from afm_rl.storage.files import write_whole

FORMS = {
    "no correction": ["method=physics"],
    "as published": ["method=afm_physics", "corrector=paper"],
    "ours": ["method=afm_physics"],
    "oracle": ["method=oracle"],
}
TURNED = "regimes=[{v_gain: -1, omega_gain: 2}]"  # a regime of the paper
TRAPS = {
    "reversed motors, commands two steps late": "regimes=[{v_gain: -1, delay: 2}]",
    "patches of ground on which driving is reversed": "regimes=[{patch_v_gain: -1}]",
}
CAUSES = ("no fault", "a recent change", "2 steps late", "another ground")


def agent_of(*overrides: str) -> Agent:
    """Return an agent on the first track, its parts trained or taken from the cache."""
    with initialize_config_module("afm_rl.conf", version_base=None):
        cfg = compose("config", ["tracks=ethz_1", "seeds=1", *overrides])
    agent = build(cfg)
    prepare(agent, cfg.cache, progress=True)
    return agent


def draw_progress(axes: Axes, budget: int) -> None:
    """Draw the targets reached against steps, for each form of the method."""
    styles = method_styles(FORMS)
    for name, overrides in FORMS.items():
        steps = run(agent_of(TURNED, f"budget={budget}", *overrides)).steps
        styles[name].line(axes, steps["t"], steps["reached"], gid=name, label=name)
        if name == "oracle":
            turned = steps.loc[steps["regime_active"] > 0, "t"]
            axes.axvspan(turned.min(), budget, color="#e69f00", alpha=0.15, lw=0)
            axes.annotate("reversed, turning doubled", (turned.min() + 5, 1), fontsize=8)
    axes.set(xlabel="step", ylabel="targets reached", xlim=(0, budget), ylim=(0, 35))
    axes.legend(frameon=False, fontsize=8)


@torch.no_grad()
def draw_belief(above: Axes, below: Axes, regimes: str, budget: int) -> None:
    """Draw driving as planned, executed and effective; below, how probable the models are."""
    agent = agent_of("method=afm_physics", regimes, f"budget={budget}")
    start, beliefs = agent.env.reset(agent.missions, set_state=False), []

    def note(*_: object) -> None:
        beliefs.append(agent.transform.corrector.belief_in(agent.transform.memory)[0, :, 0])

    how = {"auto_reset": False, "tensordict": start, "callback": note}
    rollout = agent.env.rollout(budget, agent.planner, **how)
    entries, pose = rollout["next", "afm"][0], rollout["observation"][0]
    first = int(entries["corrected"].int().argmax()) - 5
    shown, times = slice(first, first + 80), range(first, min(first + 80, len(pose)))
    moved = rollout["next", "observation"][0] - pose
    ahead = moved[:, 0] * pose[:, 2].cos() + moved[:, 1] * pose[:, 2].sin()
    driving = {
        "planned": entries["planned_action"][:, 0],
        "executed": entries["executed_action"][:, 0],
        "effective": ahead / agent.robot.model.dt,
    }
    draw_lines(above, times, {name: values[shown] for name, values in driving.items()})
    believed, names = torch.stack(beliefs)[shown], agent.transform.corrector.causes
    draw_lines(below, times, {name: believed[:, names.index(name)] for name in CAUSES})
    above.set(ylabel="v (m/s)", ylim=(-1.1, 1.1))
    below.set(xlabel="step", ylabel="probability", ylim=(0, 1))


def draw_lines(axes: Axes, times: range, curves: dict[str, torch.Tensor]) -> None:
    """Draw curves over time, with their names."""
    styles = method_styles(curves)
    for name, values in curves.items():
        styles[name].line(axes, times, values, gid=name, label=name, linewidth=1.2)
    dress(axes)


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/explain_afm"))
    parser.add_argument("--budget", type=int, default=900, help="steps of a mission")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)

    figure = new_figure(6.0, 3.2)
    axes = figure.subplots()
    dress(axes)
    draw_progress(axes, asked.budget)
    write_whole(asked.out / "afm_forms.png", png_bytes(figure))

    figure = new_figure(9.0, 5.2)
    panels = figure.subplots(2, 2, sharex="col")
    for column, (title, regimes) in zip(panels.T, TRAPS.items(), strict=True):
        draw_belief(*column, regimes, asked.budget)
        column[0].set_title(title, fontsize=9)
    for row in panels:
        row[0].legend(frameon=False, fontsize=7)
    write_whole(asked.out / "afm_views.png", png_bytes(figure))


if __name__ == "__main__":
    main()
