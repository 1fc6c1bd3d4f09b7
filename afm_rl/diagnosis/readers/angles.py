"""Roll, pitch and yaw of quaternions, beside what was logged."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from afm_rl.diagnosis.readers.source import Source

ANGLES = ("roll", "pitch", "yaw")
SPELLINGS = (
    (re.compile(r"((?:.*\.)?q(?:_d)?)\[([0-3])\]"), "0123", "{}.{}"),  # PX4's q, w first
    (re.compile(r"(.+)\.([wxyz])"), "wxyz", "{}.{}"),  # ROS
    (re.compile(r"(.*)q_?([wxyz])"), "wxyz", "{}{}"),  # columns of tables
)


def angles_of(quaternion: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad) ``(N, 3)`` of quaternions ``(N, 4)``, w first.

    These are the intrinsic rotations about z, y and x, in this order; NaN where all are 0.

    >>> angles_of(np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], [0.0] * 4])).round(3)
    array([[0.   , 0.   , 1.571],
           [  nan,   nan,   nan]])
    """
    angles = np.full((len(quaternion), 3), np.nan)
    known = np.isfinite(quaternion).all(1) & (np.abs(quaternion).max(1, initial=0.0) > 1e-6)
    if known.any():
        rotation = Rotation.from_quat(quaternion[known][:, [1, 2, 3, 0]])
        angles[known] = rotation.as_euler("ZYX")[:, ::-1]
    return angles


def with_angles(source: Source) -> Source:
    """Return the source with roll, pitch and yaw of each quaternion among what can be named.

    >>> names = [f"vehicle_attitude.q[{k}]" for k in range(4)]
    >>> with_angles(Source("log.ulg", names, lambda wanted: {})).computed
    ['vehicle_attitude.q.roll', 'vehicle_attitude.q.pitch', 'vehicle_attitude.q.yaw']
    """
    parts_of: dict[str, tuple[list[str], int]] = {}
    for pattern, order, form in SPELLINGS:
        heads: dict[str, dict[str, str]] = {}
        for name in source.names:
            if match := pattern.fullmatch(name):
                heads.setdefault(match[1], {})[match[2]] = name
        for head, parts in heads.items():
            for k, angle in enumerate(ANGLES) if len(parts) == 4 else ():
                parts_of[form.format(head, angle)] = [parts[part] for part in order], k
    for name in set(source.names) & set(parts_of):
        del parts_of[name]
    if not parts_of:
        return source

    def read(wanted: Sequence[str]) -> Mapping[str, pd.Series]:
        logged = (part for name in wanted for part in parts_of.get(name, ([name], 0))[0])
        series = dict(source.read(list(dict.fromkeys(logged))))
        for name in wanted:
            if name in parts_of:
                parts, k = parts_of[name]
                quaternion = np.column_stack([series[part] for part in parts])
                series[name] = pd.Series(angles_of(quaternion)[:, k], series[parts[0]].index)
        return {name: series[name] for name in wanted}

    return replace(source, read=read, computed=list(parts_of))
