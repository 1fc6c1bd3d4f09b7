"""The core with onnxruntime and numpy alone: a cart whose first motor is reversed as it drives.

    afm-rl-export actuators=2 out=core.onnx
    python examples/deploy/core_alone.py core.onnx

Everything is a share of the largest action, relative to the neutral action. The same loop runs in
any language for which there is onnxruntime; the inputs' names are those of the core's records.
"""

import sys

import numpy as np
import onnxruntime

REVERSED = 20  # step
STD = 0.01  # of the cart's own model

session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
outputs = [output.name for output in session.get_outputs()]
kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64}
# The first tick knows nothing: zeros, but a first guess of the noise, and the bounds of commands.
given = {entry.name: np.zeros(entry.shape, kinds[entry.type]) for entry in session.get_inputs()}
given["memory.noise"][:] = 0.05
for bound in ("plan.low", "plan.limit_low"):
    given[bound][:] = -1.0
for bound in ("plan.high", "plan.limit_high"):
    given[bound][:] = 1.0
position, goal = np.zeros(2), np.ones(2)
for step in range(60):
    if step % 15 == 0:
        goal = -goal  # it drives there and back
    given["plan.action"][:] = np.clip(goal - position, -0.5, 0.5)
    found = dict(zip(outputs, session.run(outputs, given), strict=True))
    command, note = found["step.command"], "corrected" if found["step.corrected"] else ""
    for name in outputs:
        if name.startswith("next_memory."):
            given[name.removeprefix("next_")] = found[name]
    # The robot. Its own model expects that a command moves it by a fifth of the command.
    effect = command * ([-1.0, 1.0] if step >= REVERSED else 1.0)
    position = position + 0.2 * effect
    # The command that explains the motion: here one line, for other models measure.onnx.
    innovation = np.abs(0.2 * (effect - command)).max() / STD
    measured = {"commands": command[:, None], "effects": effect[:, None], "stds": STD / 0.2}
    measured |= {"validity": 1.0, "innovation": innovation}
    for name, value in measured.items():
        given[f"measurement.{name}"][:] = value
    print(f"{step:2} planned {given['plan.action']} moved {effect} {note}")
