"""Curves for TensorBoard."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from torch.utils.tensorboard import SummaryWriter

from afm_rl.report.cells import steps_of, with_cells
from afm_rl.storage.files import write_whole
from afm_rl.storage.measures import Measures

# TensorBoard orders groups by name: whether plans came true stands first.
GROUPS = {"miss": "came_true", "unforeseen": "came_true", "error": "model", "loss": "model"}
FILE = "events.out.tfevents.0.afm_rl"  # TensorBoard looks for "tfevents" in the name


def write_events(
    folder: Path,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    points: int = 500,
    most: int = 8,
) -> list[Path]:
    """Write a sub-folder per method, and in it one for each of its first missions.

    A method's curves are means over the missions that are still running: ``came_true/miss``, the
    distance from the plan, ``came_true/unforeseen``, that from the prediction of model and
    correction; ``model/error`` and ``model/loss``; ``step/misaligned``, ``step/regime_active`` and
    what the robot's score logs. ``final/COLUMN`` is the mean of a measure over all missions. The
    only mission of a method has no folder of its own: its curves are the means.

    Args:
        folder: where to.
        missions: one row per mission.
        steps: one row per mission and step.
        measures: what methods are compared by.
        points: of a curve.
        most: missions of a method with curves of their own.

    Returns:
        The files written.
    """
    stride = math.ceil((int(steps["t"].max()) + 1) / points)
    final, columns = [measure.column for measure in measures], list(steps)
    last = columns[columns.index("regime_active") :]  # and what the score logs
    logged = ["t", *(name for name in GROUPS if name in steps), "misaligned", *last]
    groups = with_cells(missions).groupby("method", sort=False)
    written = []
    for name, (_, group) in zip(folder_names(groups.groups), groups, strict=True):
        own, place = steps[steps["mission"].isin(group["mission"])], folder / name
        written.append(_write(place, curves(own[logged], stride), group[final].mean()))
        single = group[: most if len(group) > 1 else 0]
        titles = folder_names(single["cell"] + ", seed " + single["seed"].astype(str))
        rows = steps_of(own, single["mission"])
        for title, (_, row) in zip(titles, single.iterrows(), strict=True):
            curve = curves(rows[row["mission"]][logged], stride)
            written.append(_write(place / title, curve, row[final]))
    return written


def curves(steps: pd.DataFrame, stride: int) -> pd.DataFrame:
    """Return the means over missions, and over ``stride`` steps at a time.

    >>> steps = pd.DataFrame({"t": [0, 1, 2], "loss": [1.0, 2.0, 4.0]})
    >>> curves(steps, 2)["loss"].to_dict()
    {0: 1.5, 2: 4.0}
    """
    return steps.drop(columns="t").groupby(steps["t"] // stride * stride).mean()


def folder_names(names: Iterable[str]) -> list[str]:
    """Return a folder name for each name, no two alike.

    >>> folder_names(["oval, v_gain = -1", "a/b", "A b"])
    ['oval_v_gain=-1', 'a_b', 'A_b_']
    """
    folders: list[str] = []
    taken = set()
    for name in names:
        folder = re.sub(r"[^\w.=+-]+", "_", str(name).replace(" = ", "=")).lstrip(".")[:100]
        while not folder or folder.lower() in taken:  # some disks take A and a for the same
            folder += "_"
        taken.add(folder.lower())
        folders.append(folder)
    return folders


def _write(folder: Path, curve: pd.DataFrame, final: pd.Series) -> Path:
    with TemporaryDirectory() as scratch:
        with SummaryWriter(scratch) as writer:
            for name, value in final.items():
                writer.add_scalar(f"final/{name}", float(value), 0)
            for name, values in curve.items():
                tag = f"{GROUPS.get(str(name), 'step')}/{name}"
                for step, value in values.items():
                    writer.add_scalar(tag, value, step)
        (file,) = Path(scratch).iterdir()
        write_whole(folder / FILE, file.read_bytes())
    return folder / FILE
