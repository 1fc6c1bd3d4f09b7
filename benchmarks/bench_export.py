"""Time of a tick, in torch and exported.

    python benchmarks/bench_export.py

A robot with two actions and reversed motors, for which each tick is corrected, and a healthy robot,
for which no tick is. Processor time of one thread. First the policy is exported twice, which takes
a minute or two each time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import onnxruntime
import pandas as pd
import torch
from torch import Tensor

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.report.tables import markdown
from afm_rl.transforms import ActionFlowPolicy
from afm_rl.transforms.controller import Controller, export_controller

LOW, HIGH = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])


def controller(planned: bool) -> Controller:
    """Return the correction, with MPPI (300 candidates, horizon 5) or without a planner."""
    world = PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH)
    planner = MPPI(world, bounds_key=("afm", "effect_bounds"))
    policy = ActionFlowPolicy(Dubins(), planner.action_spec, ActionFlow(LOW, HIGH))
    return Controller(planner if planned else None, policy)


def drive(
    tick: Callable[..., tuple[Tensor, Tensor]], owner: Controller, ticks: int, gain: float = -0.8
) -> Tensor:
    """Return the milliseconds of each tick of a drive around a circle, without the first tenth."""
    state, model, spent = torch.zeros(3), Dubins(), torch.zeros(ticks)
    memory = owner.empty()
    for k in range(ticks):
        angle = torch.tensor(0.05 * k)
        target = torch.stack([angle.cos(), angle.sin()])
        given = [3.0 * target, owner.draw()] if owner.planner is not None else [0.7 * target]
        begun = time.thread_time()
        memory, action = tick(memory, state, *given)
        spent[k] = 1e3 * (time.thread_time() - begun)
        state = model(state, gain * action)
    return spent[ticks // 10 :]


def graph(path: Path) -> Callable[..., tuple[Tensor, Tensor]]:
    """Return the function of an exported file."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    inputs = [entry.name for entry in session.get_inputs()]
    outputs = [entry.name for entry in session.get_outputs()]

    def tick(memory: dict[str, Tensor], *given: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        fields = [memory[name.removeprefix("memory.")] for name in inputs[: -len(given)]]
        named = dict(zip(inputs, (x.numpy() for x in (*fields, *given)), strict=True))
        *later, action = map(torch.from_numpy, session.run(None, named))
        names = (name.removeprefix("next_memory.") for name in outputs)
        return dict(zip(names, later, strict=False)), action

    return tick


@torch.inference_mode()
def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--ticks", type=int, default=10_000)
    ticks = parser.parse_args().ticks
    torch.set_num_threads(1)
    rows: dict[str, dict[str, str]] = {}
    for name, planned in (("correction", False), ("MPPI and correction", True)):
        in_torch = controller(planned)
        with tempfile.TemporaryDirectory() as folder, torch.inference_mode(False):
            path = Path(folder) / "policy.onnx"
            export_controller(in_torch, path)
            exported = graph(path)
        for way, tick in {"in torch": in_torch, "exported": exported}.items():
            for what, gain in ((name, -0.8), (f"{name}, healthy", 1.0)):
                spent = drive(tick, in_torch, ticks, gain)
                p50, p99 = spent.quantile(torch.tensor([0.5, 0.99])).tolist()
                rows.setdefault(what, {})[way] = f"{p50:.2f} / {p99:.2f}"
    table = pd.DataFrame(rows).T.rename_axis("median / 99th percentile").reset_index()
    print(markdown(f"ms per tick, {ticks} ticks", table))


if __name__ == "__main__":
    main()
