"""Which planner makes the published rows of Physics: candidates, horizon, integrator, moments?

    python examples/paper/published_physics.py

One option of the paper's planner is changed at a time. All missions of a setting are a batch in a
loop of its own, because a mission of the library also logs, corrects and learns, which takes far
longer than these plans. The table compares the missions with the published means.
"""

import argparse
from typing import NamedTuple

import pandas as pd
import torch
from published_missions import missions_of, store, table_of
from torch import Tensor

from afm_rl.dynamics.dubins import dubins_step
from afm_rl.envs import load_track
from afm_rl.envs.courses.track import Course
from afm_rl.planning.mppi import smooth
from afm_rl.report.tables import markdown
from afm_rl.spaces.manifold import wrap_angle

STUDY = "physics"
TRACKS = ("ethz_1", "ethz_2")
REGIMES = ((2.5, 0.05), (1.0, -1.0), (1.0, -0.5), (2.0, 2.0), (0.1, -1.5))  # v is not reversed
SEEDS, BUDGET, DT, REACH = 2, 5000, 0.2, 0.5  # s, m
HIGH = torch.tensor([1.0, torch.pi / 2])  # m/s, rad/s
BETA, WITHIN = 0.6, 0.9545  # weight of the new action in the smoothing; share of noise below 2


class Setting(NamedTuple):
    """What may differ from the paper's planner."""

    candidates: int = 200
    horizon: int = 5
    heading: str = "before"
    """Heading in which the planner's model moves: before the turn, after it, or along the arc."""
    wrapped: bool = True
    """Whether the planner's model wraps headings to [-pi, pi)."""
    changes: tuple[float, float] = (0.15, 0.80)
    """Shares of the targets at which the regime begins and ends."""


SETTINGS = {
    "200 candidates": Setting(),
    "500 candidates": Setting(500),
    "200, horizon 3": Setting(horizon=3),
    "200, horizon 8": Setting(horizon=8),
    "200, turns first": Setting(heading="after"),
    "200, moves along the arc": Setting(heading="arc"),
    "200, headings not wrapped": Setting(wrapped=False),
    "200, change ends at 70 %": Setting(changes=(0.15, 0.70)),
}


def costs(pose: Tensor, plans: Tensor, goal: Tensor, setting: Setting) -> Tensor:
    """Return the cost ``(B, N)`` of plans ``(B, N, H, 2)`` from poses ``(B, 3)``."""
    v, turn = (DT * plans).unbind(-1)
    after = pose[:, None, None, 2] + turn.cumsum(-1)
    heading = after
    if setting.heading == "before":
        heading = after - turn
    elif setting.heading == "arc":
        heading, v = after - turn / 2, v * torch.sinc(turn / (2 * torch.pi))
    x, y = (
        (pose - goal)[:, None, None, k] + (v * part).cumsum(-1)
        for k, part in enumerate((heading.cos(), heading.sin()))
    )
    angle = wrap_angle(after) if setting.wrapped else after
    return (x.square() + y.square() + angle.square()).sqrt().sum(-1)


def best_plan(
    pose: Tensor, mean: Tensor, goal: Tensor, setting: Setting, generator: torch.Generator
) -> Tensor:
    """Return the best of the candidates ``(B, H, 2)`` around the mean plans of the last step."""
    shifted = torch.cat([mean[:, 1:], mean[:, -1:]], 1)
    share = torch.rand(len(mean), setting.candidates, *mean.shape[1:], generator=generator)
    noise = 2**0.5 * torch.erfinv(WITHIN * (2 * share - 1))  # normal, cut off
    past = shifted[:, None, 0]
    plans = smooth(shifted[:, None] + noise, past, BETA, -HIGH, HIGH, within=False)
    chosen = costs(pose, plans, goal, setting).argmin(-1)
    return plans[torch.arange(len(plans)), chosen]


def drive(setting: Setting) -> pd.DataFrame:
    """Return the missions of a setting: every track, regime and seed."""
    course, generator = Course([load_track(name) for name in TRACKS]), torch.Generator()
    generator.manual_seed(0)
    kinds = torch.cartesian_prod(*map(torch.arange, (len(TRACKS), len(REGIMES), SEEDS)))
    track, regime, seed = kinds.unbind(-1)
    gains = torch.tensor(REGIMES)[regime]
    pose = course.starts[track].clone()
    pose += 0.02 * torch.randn(pose.shape, generator=generator)
    mean = torch.zeros(len(pose), setting.horizon, 2)
    reached, steps = torch.zeros_like(track), torch.full_like(track, BUDGET - 1)
    goal = torch.zeros_like(pose)  # with heading 0
    for step in range(BUDGET):
        at = (~course.finished(track, reached)).nonzero().squeeze(-1)  # those on their way
        if not len(at):
            break
        goal[at, :2] = course.goal(track[at], reached[at])
        mean[at] = best_plan(pose[at], mean[at], goal[at], setting, generator)
        progress = course.progress(track[at], reached[at])
        changed = (progress > setting.changes[0]) & (progress <= setting.changes[1])
        action = torch.where(changed[:, None], gains[at], 1.0) * mean[at, 0]
        noise = 1e-5 * torch.randn(len(at), 3, generator=generator)
        pose[at] = dubins_step(pose[at], action, DT) + noise
        hit = (pose[at] - goal[at])[:, :2].norm(dim=-1) < REACH
        reached[at] += hit
        steps[at] = torch.where(course.finished(track[at], reached[at]), step, steps[at])
    names = [_words(*pair) for pair in REGIMES]
    columns = {
        "method": "physics",
        "track": [TRACKS[k] for k in track],
        "regime": [names[k] for k in regime],
        "seed": seed,
        "success_rate": course.progress(track, reached),
        "steps": steps,
    }
    return pd.DataFrame(columns)


def _words(v_gain: float, omega_gain: float) -> str:
    """Return what missions call a regime: gains of 1 are not named."""
    gains = {"v_gain": v_gain, "omega_gain": omega_gain}
    return ", ".join(f"{name} = {gain:g}" for name, gain in gains.items() if gain != 1)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    torch.set_num_threads(1)
    runs = [drive(setting).assign(run=name) for name, setting in SETTINGS.items()]
    store(STUDY, pd.concat(runs))
    print(markdown(STUDY, table_of(missions_of(STUDY))))
