"""An MJCF of others as MuJoCo's binary model: what a child process does."""

from __future__ import annotations

import json

import numpy as np

from afm_rl.dynamics.mjcf_sizes import check_sizes


def compile_mjcf(name: str, source: str) -> bytes:
    """Return a line with MuJoCo's warnings, and the binary model (MJB) of an MJCF.

    Its first state is computed, because what a model takes is partly allocated there.

    Args:
        name: of the setting, for messages.
        source: path of a file, or text that begins with ``<``.

    Raises:
        ConfigurationError: if it asks for more than a robot needs.
        Exception: of MuJoCo.
    """
    import mujoco

    check_sizes(name, source)
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    mjcf = mujoco.MjModel
    is_text = source.lstrip().startswith("<")
    model = mjcf.from_xml_string(source) if is_text else mjcf.from_xml_path(source)
    mujoco.mj_forward(model, mujoco.MjData(model))
    binary = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    return json.dumps(warnings).encode() + b"\n" + binary.tobytes()
