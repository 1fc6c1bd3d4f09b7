"""Write what the page needs on which robots run: packages of npm, robots, policies and graphs.

python docs/theme/browser.py   # `make docs` brings in the packages, and calls it

Each becomes a script of its own, with its files compressed.
"""

import base64
import gzip
import hashlib
import json
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILT = ROOT / "build" / "try"
ROBOTS = {  # MJCF file of gymnasium, and policy
    "half_cheetah": ("half_cheetah.xml", "half_cheetah_tqc"),
    "ant": ("ant.xml", "ant_trpo"),
    "walker2d": ("walker2d_v5.xml", "walker2d_tqc"),
}
# With their checksums, as they were when this page was tested.
PACKAGES = json.loads(Path(__file__).with_name("packages.json").read_text())
SCRIPTS = (*PACKAGES, "robots")


def script(name, files):
    """Return files ``{name: bytes}`` as a script, which adds them to ``PACKS``."""
    packed = {file: gzip.compress(data, mtime=0) for file, data in files.items()}
    coded = {file: base64.b64encode(data).decode() for file, data in packed.items()}
    return f"PACKS[{json.dumps(name)}] = {json.dumps(coded)};\n"


def files_of(package, sha512, files):
    """Return files of a package of npm.

    Raises:
        ValueError: with a line that says what is missing.
    """
    path = BUILT / package
    if not path.is_file():
        raise ValueError(f"{package} is missing: `make docs` brings it in, by npm")
    if hashlib.sha512(path.read_bytes()).hexdigest() != sha512:
        raise ValueError(f"{path}: another checksum than the one in packages.json")
    with tarfile.open(path) as archive:
        return {k: archive.extractfile(f"package/{file}").read() for k, file in files.items()}


def robots():
    """Return models, policies, and the graphs of the correction for so many actuators.

    Raises:
        ConfigurationError: if what writes graphs is missing.
    """
    import mujoco
    import torch
    from gymnasium.envs.mujoco import mujoco_env

    from afm_rl.compiling.onnx_graph import as_onnx
    from afm_rl.compiling.tracing import without_branches
    from afm_rl.correction.belief import beliefs
    from afm_rl.correction.core import RegressionCore
    from afm_rl.correction.export import first_records, search_graph, tick_graph
    from afm_rl.planning import load_policy

    class Belief(torch.nn.Module):
        """How probable the hypotheses are, of each actuator."""

        read = "commands", "losses", "noise"  # of the memory

        def __init__(self, core):
            super().__init__()
            self.core, (self.memory, _, _) = core, first_records(core)

        def forward(self, *fields):
            memory = self.memory._replace(**dict(zip(self.read, fields, strict=True)))
            return beliefs(self.core.table, self.core.settings, memory)

    files, core = {}, None
    for name, (model, policy) in ROBOTS.items():
        path = Path(mujoco_env.__file__).parent / "assets" / model
        body = mujoco.MjModel.from_xml_path(str(path))
        actor, _ = load_policy(ROOT / "examples" / "policies" / "zoo" / f"{policy}.safetensors")
        seen = torch.zeros(next(actor.parameters()).shape[1])
        files[f"{name}.xml"] = path.read_bytes()
        files[f"{name}.onnx"] = as_onnx(actor, {"seen": seen}, ["action"], {})
        if f"core_{body.nu}.onnx" in files:
            continue
        core = RegressionCore(body.nu).to(torch.float32)
        with without_branches():  # a minute less for each
            files[f"core_{body.nu}.onnx"] = tick_graph(core)
        files[f"measure_{body.nu}.onnx"] = search_graph(core, 2 * body.nv)
        weigh = Belief(core)
        given = {f"memory.{name}": getattr(weigh.memory, name) for name in weigh.read}
        files[f"belief_{body.nu}.onnx"] = as_onnx(weigh, given, ["weights"], {})
    return files | {"hypotheses.json": json.dumps(core.table.names).encode()}


def main():
    """Write the scripts, or say why not."""
    try:
        packs = {name: files_of(**package) for name, package in PACKAGES.items()}
        packs["robots"] = robots()
    except (ImportError, ValueError) as error:  # the site is built without
        sys.exit(f"docs: the page Try it here cannot run anything: {error}")
    for name, files in packs.items():
        (BUILT / f"{name}.js").write_text(script(name, files))


if __name__ == "__main__":
    main()
