"""What is written down of a batch of missions."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import torch
from torch import Tensor


class StepLog:
    """One row per mission and step, kept as tensors until a table is asked for.

    Args:
        columns: names of the values.
        whole: the columns that hold whole numbers.

    >>> log = StepLog(["x", "reached"], whole=["reached"])
    >>> log.add(torch.tensor([4, 7]), 0, torch.tensor([[0.5, 1.0], [0.6, 2.0]]))
    >>> log.table().values.tolist()
    [[4.0, 0.0, 0.5, 1.0], [7.0, 0.0, 0.6000000238418579, 2.0]]
    """

    def __init__(self, columns: Sequence[str], whole: Sequence[str] = ()) -> None:
        self.columns = list(columns)
        self.whole = list(whole)
        self._missions: list[Tensor] = []
        self._values: list[Tensor] = []
        self._steps: list[int] = []

    def add(self, missions: Tensor, step: int, values: Tensor) -> None:
        """Add one step of the missions ``(B,)``: ``(B, C)``."""
        self._missions.append(missions.cpu())
        self._values.append(values.detach().float().cpu())
        self._steps.append(step)

    def table(self) -> pd.DataFrame:
        """Return everything, ordered by mission and step."""
        counts = torch.tensor([len(part) for part in self._missions])
        missions = torch.cat(self._missions)
        steps = torch.tensor(self._steps).repeat_interleave(counts)
        order = torch.argsort(missions * (steps.max() + 1) + steps)
        values = torch.cat(self._values)[order].numpy()
        frame = pd.DataFrame(values, columns=self.columns)
        frame.insert(0, "t", steps[order].int().numpy())
        frame.insert(0, "mission", missions[order].int().numpy())
        return frame.astype({name: "int32" for name in self.whole})
