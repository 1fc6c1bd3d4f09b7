"""The command ``afm-rl-export``."""

from __future__ import annotations

import sys

from afm_rl.cli.error_messages import errors_in_one_line
from afm_rl.cli.overrides import checked

NAME = "afm-rl-export"
ABOUT = """\
Write planner and correction of a method as an ONNX graph, which onnxruntime runs without this
library and without torch; or the core of the correction, which does not depend on the robot.

  afm-rl-export method=afm_physics out=policy.onnx
  afm-rl-export method=afm_physics planner.candidates=1000 out=policy.onnx
  afm-rl-export method=afm_physics out=policy.onnx planner=null   the planned action is an input
  afm-rl-export actuators=6 out=core.onnx                         the core
  afm-rl-export actuators=6 coordinates=18 out=measure.onnx       its input, with your own model

The settings are those of afm-rl. The file is a function of tensors: (memory, observation, the
task's entries such as the goal, noise) -> (memory, action). A mission starts with a memory of
zeros; the metadata of the file has the size of each argument. Python and C++ can run the file
(examples/deploy).

The core takes a memory, a measurement and a plan, by named inputs, and returns the next memory and
a step. The measurement is the effective action under your own model: the function in measure.onnx
queries your model, whose states have D coordinates, until the effective action is known
(examples/deploy/core_alone.py).
"""
ALONE = "planner=null"


def main() -> None:
    """Run ``afm-rl-export``; a mistake ends with one line of text and exit status 2."""
    arguments = sys.argv[1:]
    if not arguments or {"-h", "--help"} & set(arguments):
        print(ABOUT, end="")
        return
    with errors_in_one_line(NAME):
        core = any(text.startswith("actuators=") for text in arguments)
        (_export_core if core else _run)(arguments)


def _export_core(arguments: list[str]) -> None:
    from pathlib import Path

    import torch

    from afm_rl.compiling.onnx_graph import load_runtime
    from afm_rl.correction.core import RegressionCore
    from afm_rl.correction.export import search_graph, tick_graph
    from afm_rl.errors import ConfigurationError
    from afm_rl.storage.files import write_whole

    given = dict(text.partition("=")[::2] for text in arguments)
    path = Path(given.pop("out", ""))
    sizes = {name: int(text) if text.isdigit() else 0 for name, text in given.items()}
    if path.suffix in (".c", ".h"):
        raise ConfigurationError(
            f"out={path}: graphs are written as ONNX, not as C; write NAME.onnx, and run it with "
            "the C API of onnxruntime (examples/deploy/cpp)"
        )
    known = sizes.keys() <= {"actuators", "coordinates"} and all(sizes.values())
    if not known or path.suffix != ".onnx" or not path.parent.is_dir():
        raise ConfigurationError(
            f"{' '.join(arguments)}: expected actuators=N out=NAME.onnx, in a folder that exists; "
            "coordinates=D, the number of coordinates of your model's state, writes the search "
            "that queries your model"
        )
    load_runtime()
    print("exporting: tracing, then writing, a minute in all", flush=True)
    core = RegressionCore(sizes["actuators"]).to(torch.float32)
    wanted = sizes.get("coordinates")
    write_whole(path, tick_graph(core) if wanted is None else search_graph(core, wanted))
    print(f"wrote {path}")


def _run(arguments: list[str]) -> None:
    import torch
    from hydra import compose, initialize_config_module
    from hydra.core.global_hydra import GlobalHydra
    from torchrl.data import Bounded

    from afm_rl.errors import ConfigurationError
    from afm_rl.learning import Updater
    from afm_rl.missions import build, prepare
    from afm_rl.transforms.controller import Controller, check_exportable, export_controller
    from afm_rl.transforms.policy import ActionFlowPolicy

    # Where to, and the method that the settings ask for.
    out = [text.removeprefix("out=") for text in arguments if text.startswith("out=")]
    if len(out) != 1:
        raise ConfigurationError("out: expected one file to write, as in out=policy.onnx")
    path, alone = check_exportable(out[0]), ALONE in arguments
    given = [text for text in arguments if text != ALONE and not text.startswith("out=")]
    GlobalHydra.instance().clear()
    with (
        checked(given) as packages,
        initialize_config_module("afm_rl.conf", version_base="1.3"),
    ):
        cfg = compose("config", given)
        agent = build(cfg, packages)
    # What can be exported: a correction over a model that stays as it is.
    if agent.transform is None:
        raise ConfigurationError(
            "corrector=none: nothing to export; choose a method with a correction, such as "
            "method=afm_physics"
        )
    if type(agent.updater) is not Updater or agent.model.conditioned_on is not None:
        raise ConfigurationError(
            "export: the model of this method learns during operation, an exported one cannot; "
            "choose a method that does not learn, such as afm_physics or afm_frozen_pe"
        )
    check_exportable(path, None if alone else agent.planner)
    # Its parts, trained, on the processor that will run it, as one controller.
    prepare(agent, cfg.cache, progress=bool(cfg.progress))
    agent.to(torch.device("cpu"))
    transform, (low, high) = agent.transform, agent.robot.action_bounds
    policy = ActionFlowPolicy(
        agent.model,
        Bounded(low, high, shape=low.shape, dtype=low.dtype),
        transform.corrector,
        transform.observation_key,
        transform.action_key,
        transform.prefix,
        **transform.options,
    )
    print("exporting: tracing, then writing, which takes several times as long", flush=True)
    controller = Controller(None if alone else agent.planner, policy)
    checksum = export_controller(controller, path)
    sizes = ", ".join(f"{name} ({size})" for name, size in controller.sizes.items())
    print(f"wrote {path}: memory, by name, {sizes}")
    print(f"sha256 {checksum}: programs that load the file should check it")


if __name__ == "__main__":
    main()
