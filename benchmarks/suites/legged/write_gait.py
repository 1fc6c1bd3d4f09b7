"""Write the gait of the small robot, a trot by the clock alone, as its policy.

    python benchmarks/suites/legged/write_gait.py --out FILE

The observation is cosine and sine of two phases; hips follow the sine, knees the cosine.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper

from afm_rl.storage.files import write_whole

PHASE_OF = (0, 1, 1, 0)  # of the legs: front right, front left, rear right, rear left


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    weight = np.zeros((4, 8), dtype=np.float32)
    for leg, phase in enumerate(PHASE_OF):
        weight[2 + phase, 2 * leg] = weight[phase, 2 * leg + 1] = 1.0
    rows = {"obs": [1, 4], "continuous_actions": [1, 8]}
    seen, action = (helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in rows.items())
    node = helper.make_node("MatMul", ["obs", "weight"], ["continuous_actions"])
    weights = [numpy_helper.from_array(weight, "weight")]
    graph = helper.make_graph([node], "trot", [seen], [action], weights)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=9)
    checker.check_model(model)
    write_whole(args.out, model.SerializeToString())


if __name__ == "__main__":
    main()
