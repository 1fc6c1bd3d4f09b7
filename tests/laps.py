"""Made-up results of three methods on a small round track."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pandas as pd

from afm_rl.storage.files import csv_text
from afm_rl.storage.manifest import write_manifest
from afm_rl.storage.measures import Measure, Measures

LAPS = Measures(
    (
        Measure(
            *("success_rate", "success", "targets reached", "%", "higher"),
            **{"scale": 100.0, "digits": 1, "limits": (0.0, 1.0), "headline": True},
        ),
        Measure("steps", "steps", "steps", better="lower", headline=True, budget=True),
    ),
    progress=("reached", "targets"),
    error_unit="m, rad",
)
RADIUS, TARGETS, BUDGET = 4.0, 8, 400
STEPS = {"physics": BUDGET, "adaptive": 120, "oracle": 100}  # physics is given up


def track(name="ring"):
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    line = RADIUS * np.stack([np.cos(angle), np.sin(angle)], -1)
    return SimpleNamespace(name=name, waypoints=line[:: 90 // TARGETS], centerline=line, width=1.5)


def drive(method: str, number: int, seed: int) -> pd.DataFrame:
    """Steps of one mission: round the ring, or, under the regime, off and away."""
    rng, length = np.random.default_rng(seed), STEPS[method]
    t = np.arange(length)
    progress = t / STEPS["oracle"] if method == "physics" else t / length
    astray = (method == "physics") & (progress > 0.25)
    active = (progress > 0.2) & ((progress < 0.8) | astray)
    angle = 2 * np.pi * np.minimum(progress, 1.0)
    along = np.maximum(progress - 0.25, 0) * 2 * np.pi * RADIUS
    x = np.where(astray, -along, RADIUS * np.cos(angle))
    y = np.where(astray, RADIUS, RADIUS * np.sin(angle))
    wrong = active & (method != "oracle")
    error = np.where(wrong, 0.4, 1e-5) * rng.uniform(0.8, 1.2, length)
    reached = np.where(astray, 2, np.minimum(TARGETS * progress, TARGETS)).astype("int32")
    goal = RADIUS * np.stack([np.cos(angle + 0.5), np.sin(angle + 0.5)])
    table = pd.DataFrame({"mission": np.int32(number), "t": t.astype("int32"), "x": x, "y": y})
    table = table.assign(theta=angle, goal_x=goal[0], goal_y=goal[1])
    table = table.assign(planned_v=1.0, planned_omega=0.0, executed_v=1.0, executed_omega=0.0)
    table = table.assign(error=error, miss=error, unforeseen=error / 2)
    loss = np.where(wrong, 5e4, -3.0) * rng.uniform(0.8, 1.2, length)
    table = table.assign(corrected=wrong.astype("int32"), loss=loss)
    return table.assign(regime_active=active.astype("int32"), reached=reached)


def results(methods=tuple(STEPS), v_gains=(-1.0,), seeds=1, tracks=("ring",)):
    """Data frames of missions and steps, as a batch of missions gives them."""
    missions, steps = [], []
    for number, (method, name, gain, seed) in enumerate(
        product(methods, tracks, v_gains, range(seeds))
    ):
        rows = drive(method, number, seed)
        reached = 2 if method == "physics" else TARGETS
        steps.append(rows)
        row = {"mission": number, "method": method, "track": name, "v_gain": gain}
        row |= {"omega_gain": 1.0, "seed": seed, "success_rate": np.float32(reached / TARGETS)}
        row |= {"steps": len(rows) - 1 + seed, "reached": reached, "targets": TARGETS}
        row |= {"finished": reached == TARGETS, "seconds": np.float32(0.1 * (number + 1))}
        missions.append(row)
    return pd.DataFrame(missions), pd.concat(steps, ignore_index=True)


def write_results(folder, missions, steps, measures=LAPS):
    """Write the folder of a run: tables, measures and manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "missions.csv").write_text(csv_text(missions))
    (folder / "measures.json").write_text(measures.to_json())
    steps.to_parquet(folder / "steps.parquet", index=False)
    write_manifest(folder)
    return folder
