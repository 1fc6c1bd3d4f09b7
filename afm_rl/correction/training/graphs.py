"""The core as ONNX graphs, one for each number of actuators.

    python -m afm_rl.correction.training.graphs   # writes them anew, after a change of the core

Units are shares of the largest action; a host gives the effective action of its own model.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor, nn

from afm_rl.compiling.onnx_graph import as_onnx, trace
from afm_rl.correction import ActionFlow
from afm_rl.correction.core import Core, Plan, Tick
from afm_rl.correction.flow_options import SIZES
from afm_rl.correction.in_c import graph_file, sources
from afm_rl.storage.files import write_whole

INPUTS = ("memory", "measured", "planned", "box", "limits")
OUTPUTS = ("next_memory", "command", "predicted", "spread", "bounds", "corrects")
MEANINGS = {
    "memory": "what is remembered: zeros at first, but .05 in the last numbers, one per actuator; "
    "then next_memory of the tick before",
    "measured": "the newest pair: the command that acted, its effective action and the standard "
    "deviation of that; 1 if they count, else 0; the innovation, in standard deviations",
    "planned": "the plan",
    "box": "the lowest command, and the highest",
    "limits": "the lowest and the highest command, whatever would be best; the box, if none",
    "next_memory": "the memory of the next tick",
    "command": "what to send to the robot",
    "predicted": "the effect that is expected of it",
    "spread": "standard deviation of the flow's samples",
    "bounds": "the lowest effect that a command may have, and the highest",
    "corrects": "is it another command than the plan?",
}


class CoreGraph(nn.Module):
    """The core for one robot and one pair at each tick."""

    def __init__(self, core: Core) -> None:
        super().__init__()
        self.core = core

    def forward(self, memory: Tensor, measured: Tensor, *plan: Tensor) -> Tick:
        """Return the tick, see :meth:`afm_rl.correction.core.Core.forward`."""
        with torch.no_grad():
            return self.core.forward(memory, measured.unsqueeze(-2), Plan(*plan))

    def example(self) -> list[Tensor]:
        """Return inputs of the first tick."""
        size, high = self.core.action_size, torch.ones(self.core.action_size)
        memory, measured = torch.zeros(sum(self.core.learnt.sizes)), torch.zeros(3 * size + 2)
        memory[-size:], measured[2 * size : 3 * size] = 0.05, 1.0
        box = torch.stack([-high, high])
        return [memory, measured, torch.zeros(size), box, box.clone()]


def core_graph(core: Core) -> bytes:
    """Return the core as an ONNX graph."""
    graph = CoreGraph(core)
    traced = trace(graph, graph.example())
    return as_onnx(traced, INPUTS, OUTPUTS, {**MEANINGS, "sources": sources()})


def main(sizes: list[int]) -> None:
    """Write the graphs for so many actuators; for all of them, if none are named."""
    for size in sizes or SIZES:
        write_whole(graph_file(size), core_graph(ActionFlow(-torch.ones(size), torch.ones(size))))
        print(f"{graph_file(size).name}: {graph_file(size).stat().st_size:,} bytes")


if __name__ == "__main__":
    main([int(size) for size in sys.argv[1:]])
