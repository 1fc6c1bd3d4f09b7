"""The core under numpy alone: a cart with two motors, one of which is reversed while it drives.

afm-rl-export actuators=2 out=core.c
cc -O2 -shared -fPIC -o core.so core.c -lm
python examples/deploy/c/numpy_alone.py core.so core.h
"""

import ctypes
import re
import sys
from pathlib import Path

import numpy as np

library, header = ctypes.CDLL(str(Path(sys.argv[1]).resolve())), Path(sys.argv[2]).read_text()
sizes = {name: int(size) for name, size in re.findall(r"afm_core_(\w+) = (\d+)", header)}
A, REVERSED = sizes["command"], 20
arrays = {name: np.zeros(size, np.float32) for name, size in sizes.items()}
arrays["corrects"] = np.zeros(1, np.bool_)
workspace = np.empty(ctypes.c_size_t.in_dll(library, "afm_core_workspace").value + 64, np.uint8)
aligned = ctypes.c_void_p(-(-workspace.ctypes.data // 64) * 64)

# A memory of zeros, with a first guess of the noise; no pair was seen yet, so none counts.
arrays["memory"][-A:] = 0.05
arrays["measured"][2 * A : 3 * A] = 1.0
arrays["box"][:] = arrays["limits"][:] = [-1.0] * A + [1.0] * A
position, goal = np.zeros(A), np.ones(A)
for step in range(60):
    if step % 15 == 0:
        goal = -goal  # it drives there and back
    arrays["planned"][:] = np.clip(goal - position, -0.5, 0.5)
    rows = (array.ctypes.data_as(ctypes.c_void_p) for array in arrays.values())
    library.afm_core(ctypes.c_size_t(1), *rows, aligned)
    arrays["memory"][:] = arrays["next_memory"]
    # The robot; its own model is that it moves by a fifth of the command.
    effect = arrays["command"] * ([-1.0, 1.0] if step >= REVERSED else 1.0)
    position = position + 0.2 * effect
    # What the model needs to explain it: here one line, for others the function afm_measure.
    std, innovation = np.full(A, 0.01), np.abs(effect - arrays["command"]).max() / 0.01
    arrays["measured"][:] = np.concatenate([arrays["command"], effect, std, [1.0, innovation]])
    told = ("", ", corrected")[int(arrays["corrects"][0])]
    print(f"{step:2} planned {arrays['planned']} moved {effect}{told}")
