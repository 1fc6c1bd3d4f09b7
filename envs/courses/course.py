"""Several tracks as tensors, so that each mission of a batch drives on its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from afm_rl.envs.courses.track import Track


class Course(nn.Module):
    """The targets of T tracks, looked up per mission.

    Args:
        tracks: the tracks.
        dtype: floating-point type.

    Attributes:
        targets: targets (m), ``(T, N, 2)``, short rows padded with their last target.
        counts: number n of targets per track, ``(T,)``.
        starts: start poses (m, m, rad), ``(T, 3)``.

    >>> from afm_rl.envs.courses.tracks import load_track
    >>> course = Course([load_track("ethz_1"), load_track("ethz_2")])
    >>> course.counts
    tensor([34, 19])
    >>> course.progress(torch.tensor([0, 1]), torch.tensor([17, 19]))
    tensor([0.5000, 1.0000])
    """

    targets: Tensor
    counts: Tensor
    starts: Tensor

    def __init__(self, tracks: Sequence[Track], dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        rows = [track.targets for track in tracks]
        counts = [len(row) for row in rows]
        padded = [torch.cat([row, row[-1:].expand(max(counts) - len(row), 2)]) for row in rows]
        starts = torch.stack([track.start for track in tracks])
        self.register_buffer("targets", torch.stack(padded).to(dtype), persistent=False)
        self.register_buffer("counts", torch.tensor(counts), persistent=False)
        self.register_buffer("starts", starts.to(dtype), persistent=False)

    def goal(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return the current target ``(*B, 2)``; after the last one it stays the last."""
        return self.targets[track, reached.minimum(self.counts[track] - 1)]

    def progress(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return the share of targets reached ``(*B)``, in [0, 1]."""
        return reached.to(self.targets.dtype) / self.counts[track]

    def finished(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return whether all targets are reached ``(*B)``."""
        return reached >= self.counts[track]
