"""Write the gait of the small robot, a trot, as its policy.

    python benchmarks/suites/legged/write_gait.py --out FILE

Hips follow the sine of a phase, knees its cosine; hips also the yaw rate and the error of the
speed, knees the tilt, so the robot keeps heading, speed and balance.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper

from afm_rl.storage.files import write_whole

LEGS = ((0, -1, 1), (1, 1, 1), (1, -1, -1), (0, 1, -1))
"""Phase, side (left is 1) and end (front is 1) of each leg."""
YAW, SPEED, ROLL, PITCH = 0.15, -0.5, 2.0, 2.0


def gait() -> np.ndarray:
    """Return the weights of the 16 numbers of an observation in the 8 actions."""
    weight = np.zeros((16, 8), dtype=np.float32)
    for leg, (phase, side, end) in enumerate(LEGS):
        hip, knee = weight[:, 2 * leg], weight[:, 2 * leg + 1]
        hip[2 + phase] = knee[phase] = 1.0  # after the cosines of the phases their sines
        hip[6] = YAW * side  # gyro
        knee[7:9] = PITCH * end, ROLL * side  # gravity
        hip[10], hip[13] = SPEED, -SPEED  # speed and command
    return weight


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    weight = gait()
    sizes = {"obs": [1, len(weight)], "continuous_actions": [1, weight.shape[1]]}
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, size) for name, size in sizes.items()
    ]
    node = helper.make_node("MatMul", ["obs", "weight"], ["continuous_actions"])
    weights = [numpy_helper.from_array(weight, "weight")]
    graph = helper.make_graph([node], "trot", ends[:1], ends[1:], weights)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=9)
    checker.check_model(model)
    write_whole(args.out, model.SerializeToString())


if __name__ == "__main__":
    main()
