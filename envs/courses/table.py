"""Reference flights from files."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from afm_rl.envs.courses.columns import read_columns
from afm_rl.envs.courses.reference import Reference
from afm_rl.envs.courses.track import check_near, local_origin
from afm_rl.errors import ConfigurationError, check_choice


class Table(Reference):
    """Positions and velocities at given times, linear in between and constant outside.

    Args:
        times: increasing times (s), N of them, at least two.
        positions: ``(N, 3)`` in m.
        velocities: ``(N, 3)`` in m/s.
        name: how missions call it.

    Raises:
        ConfigurationError: for numbers that do not go together.

    >>> rows = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
    >>> Table(torch.tensor([0.0, 2.0]), rows, rows).at(torch.tensor(1.0))
    tensor([0.5000, 0.0000, 0.0000, 0.5000, 0.0000, 0.0000])
    """

    def __init__(
        self, times: Tensor, positions: Tensor, velocities: Tensor, name: str = "table"
    ) -> None:
        self.name = name
        sizes = {positions.shape, velocities.shape}
        if len(times) < 2 or sizes != {(len(times), 3)}:
            raise ConfigurationError(
                f"references: {name}: {len(times)} times, positions {tuple(positions.shape)} and "
                f"velocities {tuple(velocities.shape)}: expected N >= 2 times and (N, 3) each"
            )
        if not times.diff().gt(0).all():
            raise ConfigurationError(f"references: {name}: expected times that increase")
        check_near(positions, f"{name}: position")
        local = positions - local_origin(positions)
        self.times, self.rows = times, torch.cat([local, velocities], -1)

    def at(self, time: Tensor) -> Tensor:
        times, rows = self.times.to(time), self.rows.to(time)
        inside = time.clamp(times[0], times[-1])
        last = torch.searchsorted(times, inside.contiguous(), right=True).clamp(1, len(times) - 1)
        share = (inside - times[last - 1]) / (times[last] - times[last - 1])
        return torch.lerp(rows[last - 1], rows[last], share.unsqueeze(-1))


def load_reference(path: str | Path, velocity: str = "columns") -> Table:
    """Read a reference from a CSV file with the columns t,x,y,z,vx,vy,vz (s, m, m/s).

    Args:
        path: the file. The reference is called like it.
        velocity: ``"columns"``, or ``"differences"`` to take central differences of the
            positions; a file with the columns t,x,y,z alone is only accepted then.

    Raises:
        ConfigurationError: if the file cannot be used, or has no velocities.

    >>> load_reference("flight.csv")
    Traceback (most recent call last):
    afm_rl.errors.ConfigurationError: tracks: cannot read flight.csv: No such file or directory
    """
    check_choice("velocity", velocity, ("columns", "differences"))
    path = Path(path)
    short = ("t", "x", "y", "z")
    header, rows = read_columns(path, [(*short, "vx", "vy", "vz"), short])
    if header == short and velocity == "columns":
        raise ConfigurationError(
            f"references: {path} has no velocities: add the columns vx,vy,vz (m/s), or load it "
            'with velocity="differences"'
        )
    times, positions = rows[:, 0], rows[:, 1:4]
    velocities = rows[:, 4:] if velocity == "columns" else torch.zeros_like(positions)
    if velocity == "differences" and len(times) > 1 and times.diff().gt(0).all():
        (velocities,) = torch.gradient(positions, spacing=(times,), dim=0)
    return Table(times, positions, velocities, path.stem)
