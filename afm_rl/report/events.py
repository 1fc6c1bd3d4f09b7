"""Curves for TensorBoard."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import FileWriter

from afm_rl.artefacts import write_whole
from afm_rl.report.frames import cell_names, steps_of
from afm_rl.report.kinds import kind_of

POINTS = 1000  # per curve
SINGLE = 8  # missions of each method with curves of their own
CURVES = ["error", "loss", "misaligned", "regime_active"]
FILE = "events.out.tfevents.0.afm_rl"  # TensorBoard looks for "tfevents" in the name


def write_events(folder: Path, missions: pd.DataFrame, steps: pd.DataFrame) -> list[Path]:
    """Write a sub-folder per method, and in it one for each of its first eight missions.

    A method's curves (``step/error``, ``step/loss``, ``step/misaligned``,
    ``step/regime_active``, ``step/reached``) are means over the missions that are still
    running; ``final/success_rate`` and ``final/steps`` are means over all of them. Flights have
    squared errors instead. The only mission of a method has no folder of its own: its curves
    are the means.

    Args:
        folder: where to.
        missions: one row per mission.
        steps: one row per mission and step.

    Returns:
        The files written.
    """
    stride = math.ceil((int(steps["t"].max()) + 1) / POINTS)
    titles = cell_names(missions) + ", seed " + missions["seed"].astype(str)
    named, kind = missions.assign(title=titles), kind_of(missions)
    shown, final = [*CURVES, *kind.steps], list(kind.final)
    groups = named.groupby("method", sort=False)
    written = []
    for name, (_, group) in zip(folder_names(groups.groups), groups, strict=True):
        own, place = steps[steps["mission"].isin(group["mission"])], Path(folder) / name
        written.append(
            _write(place / FILE, curves(own[["t", *shown]], stride), group[final].mean())
        )
        single = group[: SINGLE if len(group) > 1 else 0]
        rows = steps_of(own, single["mission"])
        for title, (_, row) in zip(folder_names(single["title"]), single.iterrows(), strict=True):
            curve = curves(rows[row["mission"]][["t", *shown]], stride)
            written.append(_write(place / title / FILE, curve, row[final]))
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
        folder = re.sub(r"[^\w.=+-]+", "_", str(name).replace(" = ", "=")).lstrip(".")
        while not folder or folder.lower() in taken:  # some disks take A and a for the same
            folder += "_"
        taken.add(folder.lower())
        folders.append(folder)
    return folders


def _write(path: Path, curve: pd.DataFrame, final: pd.Series) -> Path:
    with TemporaryDirectory() as scratch:
        writer = FileWriter(scratch)
        writer.add_summary(_summary([f"final/{name}" for name in final.index], final), 0)
        tags = [f"step/{name}" for name in curve.columns]
        for step, values in zip(curve.index, curve.to_numpy(), strict=True):
            writer.add_summary(_summary(tags, values), int(step))
        writer.close()
        (file,) = Path(scratch).iterdir()
        write_whole(path, file.read_bytes())
    return path


def _summary(tags: Iterable[str], values: Iterable[float]) -> Summary:
    pairs = zip(tags, values, strict=True)
    return Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in pairs])
