"""Write a policy, the core and what asks the model as C, and compile half_cheetah.c with them.

    python examples/deploy/c/build.py outputs/cheetah  # a minute, most of it the compiler
    outputs/cheetah/half_cheetah MODEL.xml alone          # the model's place is printed
    outputs/cheetah/half_cheetah MODEL.xml afm

It needs `pip install 'afm-rl[edge,gym,onnx]'` and a C compiler; the program only MuJoCo.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mujoco
import torch
from gymnasium.envs.mujoco import mujoco_env

from afm_rl.compiling.onnx_graph import as_onnx, trace
from afm_rl.correction.in_c import write_graph
from afm_rl.planning import load_policy

HERE = Path(__file__).parent
POLICY = HERE.parents[1] / "policies" / "zoo" / "half_cheetah_sac.safetensors"
ACTUATORS, COORDINATES = 6, 18


def main(folder: Path) -> None:
    """Write sources, headers and program into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    export = [sys.executable, "-m", "afm_rl.cli.export", f"actuators={ACTUATORS}"]
    subprocess.run([*export, f"out={folder / 'core.c'}"], check=True)
    measure = [f"coordinates={COORDINATES}", f"out={folder / 'measure.c'}"]
    subprocess.run([*export, *measure], check=True)
    policy, _ = load_policy(POLICY)
    meanings = {"seen": "what the policy observes", "action": "what it plans"}
    traced = trace(policy, [torch.zeros(COORDINATES - 1)])
    write_graph(as_onnx(traced, ["seen"], ["action"], meanings), "policy", folder / "policy.c")
    library = Path(mujoco.__file__).parent
    (shared,) = library.glob("libmujoco.so.*")
    sources = [HERE / "half_cheetah.c", *(folder / f"{k}.c" for k in ("core", "measure", "policy"))]
    places = [f"-I{folder}", f"-I{library / 'include'}", f"-Wl,-rpath,{library}"]
    run = ["cc", "-O2", "-Wall", *places, "-o", folder / "half_cheetah", *sources, shared, "-lm"]
    subprocess.run(run, check=True)
    model = Path(mujoco_env.__file__).parent / "assets" / "half_cheetah.xml"
    print(f"{folder / 'half_cheetah'} {model} alone")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
