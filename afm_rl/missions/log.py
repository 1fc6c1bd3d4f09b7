"""What is written down of a batch of missions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd
import torch
from torch import Tensor


class StepLog:
    """One row per mission and step, kept in memory until a table is asked for.

    Args:
        columns: names of the values.
        whole: the columns that hold whole numbers.
        room: rows that there is room for at first.

    >>> log = StepLog(["x", "reached"], whole=["reached"])
    >>> log.add(torch.tensor([4, 7]), 0, torch.tensor([[0.5, 1.0], [0.6, 2.0]]))
    >>> log.table().values.tolist()
    [[4.0, 0.0, 0.5, 1.0], [7.0, 0.0, 0.6000000238418579, 2.0]]
    """

    def __init__(self, columns: Sequence[str], whole: Sequence[str] = (), room: int = 4096) -> None:
        self.columns = list(columns)
        self.whole = list(whole)
        self._count = 0
        self._values = torch.empty(room, len(self.columns))
        self._keys = torch.empty(room, 2, dtype=torch.int64)  # mission, step

    def __len__(self) -> int:
        return self._count

    def add(self, missions: Tensor, step: int, values: Tensor) -> None:
        """Add one step of the missions ``(B,)``: ``(B, C)``."""
        rows = slice(self._count, self._count + len(missions))
        while rows.stop > len(self._keys):
            # One block that doubles: thousands of small tensors would pin the heap in pieces
            # between the large temporaries of a learning model, and memory would grow.
            self._values = torch.cat([self._values, torch.empty_like(self._values)])
            self._keys = torch.cat([self._keys, torch.empty_like(self._keys)])
        self._values[rows] = values.detach().to(self._values)
        self._keys[rows, 0] = missions.to(self._keys)
        self._keys[rows, 1] = step
        self._count = rows.stop

    def table(self) -> pd.DataFrame:
        """Return everything, ordered by mission and step."""
        missions, steps = self._keys[: self._count].unbind(-1)
        order = torch.argsort(missions * (self._keys[: self._count, 1].max() + 1) + steps)
        frame = pd.DataFrame(self._values[: self._count][order].numpy(), columns=self.columns)
        frame.insert(0, "t", steps[order].int().numpy())
        frame.insert(0, "mission", missions[order].int().numpy())
        return frame.astype({name: "int32" for name in self.whole})

    def state_dict(self) -> dict[str, Tensor]:
        """Return all rows so far."""
        return {"values": self._values[: self._count], "keys": self._keys[: self._count]}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self._count = len(state["keys"])
        spare = max(self._count, len(self._keys))
        self._values, self._keys = (
            torch.cat([rows, rows.new_empty(spare, rows.shape[-1])])
            for rows in (state["values"], state["keys"])
        )
