"""The universal network that comes with the package."""

from __future__ import annotations

import hashlib
from importlib.resources import files

from safetensors.torch import load

from afm_rl.correction.network import AxisNetwork
from afm_rl.errors import ArtefactError

FILE = "universal.safetensors"


def load_universal() -> AxisNetwork:
    """Return the universal network, frozen.

    Raises:
        ArtefactError: if the file does not have the checksum that is written beside it.
    """
    folder = files("afm_rl.correction")
    data = folder.joinpath(FILE).read_bytes()
    expected = folder.joinpath(f"{FILE}.sha256").read_text().split()[0]
    if hashlib.sha256(data).hexdigest() != expected:
        raise ArtefactError(
            f"{FILE}: damaged, its checksum is not {expected}: install afm-rl again"
        )
    network = AxisNetwork()
    network.load_state_dict(load(data))
    return network.requires_grad_(False).eval()
