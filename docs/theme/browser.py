"""Write what the page needs that shows robots: packages of npm, robots, policies and graphs.

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
# Of each package its file, its SHA-512, as it was when this page was tested, and its files.
PACKAGES = {
    "mujoco": (
        "mujoco-mujoco-3.14.0.tgz",
        "58f51889dbb8171f3eb8ce2142ff3448e03489fa561abb0d260b8ab3c24157c4"
        "824f18ca436febaac87cf349d41f4fd5c1af2fb9e7e086f090924a1e7776e452",
        {"mujoco.js": "mujoco.js", "mujoco.wasm": "mujoco.wasm"},
    ),
    "onnxruntime": (
        "onnxruntime-web-1.30.0.tgz",
        "ab4cbe26baedba45d2cec05610c71c55fa97db92d19a8b171c5f8269126683ca"
        "590a5cdc57bb2f35ce2b298de32f4d956fb42644c0ecd528a0a91e025c07ca61",
        {
            "ort.mjs": "dist/ort.wasm.bundle.min.mjs",
            "ort.wasm": "dist/ort-wasm-simd-threaded.wasm",
        },
    ),
    "three": (
        "three-0.187.0.tgz",
        "422bbb47e0a687c0acb59b18d6e24e4969d595fa3b66d34b57b985f0996d9372"
        "c1dc0b43bbd71166572744a90093c638cfa28ac37e73ed8ed4addee3598f1eb4",
        {name: f"build/{name}" for name in ("three.core.js", "three.module.js")},
    ),
}
SCRIPTS = (*PACKAGES, "robots")


def script(name, files):
    """Return files ``{name: bytes}`` as a script, which adds them to ``PACKS``."""
    coded = {
        file: base64.b64encode(gzip.compress(data, mtime=0)).decode()
        for file, data in files.items()
    }
    return f"PACKS[{json.dumps(name)}] = {json.dumps(coded)};\n"


def files_of(package, checksum, files):
    """Return files of a package of npm.

    Raises:
        ValueError: with a line that says what is missing.
    """
    if not package.is_file():
        raise ValueError(f"{package.name} is missing: `make docs` brings it in, by npm")
    if hashlib.sha512(package.read_bytes()).hexdigest() != checksum:
        raise ValueError(f"{package}: another checksum than the one in {Path(__file__).name}")
    with tarfile.open(package) as archive:
        return {
            name: archive.extractfile(f"package/{path}").read() for name, path in files.items()
        }


def robots():
    """Return models, policies, and the graphs of the correction for so many actuators.

    Raises:
        ConfigurationError: if what writes graphs is missing.
    """
    import mujoco
    import torch
    from gymnasium.envs.mujoco import mujoco_env

    from afm_rl.compiling.onnx_graph import as_onnx, trace
    from afm_rl.correction import ActionFlow
    from afm_rl.correction.in_c import graph_file
    from afm_rl.correction.training.measuring import measure_graph
    from afm_rl.planning import load_policy

    class Look(torch.nn.Module):
        """What a memory of the core holds that a page shows or uses."""

        def __init__(self, core):
            super().__init__()
            self.core = core

        def forward(self, memory):
            fields = self.core.learnt.unpack(memory)
            begun = {name: 0 * fields[name] for name in ("under_way", "unmet")}
            resumed = self.core.learnt.pack(fields | begun)
            return self.core.weights(fields), fields["delay"], fields["under_way"], resumed

    def graph(module, size, **meanings):
        traced = trace(module, [torch.zeros(size)])
        return as_onnx(traced, list(meanings)[:1], list(meanings)[1:], meanings)

    looks = {
        "memory": "of the core",
        "weights": "how probable the hypotheses are, by actuator",
        "delay": "steps that commands are late",
        "under_way": "effects of the newest commands, the newest last",
        "resumed": "the memory, where a robot begins anew",
    }
    files = {}
    for name, (model, policy) in ROBOTS.items():
        path = Path(mujoco_env.__file__).parent / "assets" / model
        body = mujoco.MjModel.from_xml_path(str(path))
        actor, _ = load_policy(ROOT / "examples" / "policies" / "zoo" / f"{policy}.safetensors")
        seen = next(actor.parameters()).shape[1]
        files[f"{name}.xml"] = path.read_bytes()
        files[f"{name}.onnx"] = graph(actor, seen, seen="what it observes", action="its plan")
        if f"core_{body.nu}.onnx" not in files:
            core = ActionFlow(-torch.ones(body.nu), torch.ones(body.nu))
            files[f"core_{body.nu}.onnx"] = graph_file(body.nu).read_bytes()
            files[f"measure_{body.nu}.onnx"] = measure_graph(body.nu, 2 * body.nv)
            files[f"look_{body.nu}.onnx"] = graph(Look(core), sum(core.learnt.sizes), **looks)
    hypotheses = [[row.name, row.follows_delay] for row in core.hypotheses]
    return files | {"hypotheses.json": json.dumps(hypotheses).encode()}


def main():
    try:
        for name, (package, *content) in PACKAGES.items():
            text = script(name, files_of(BUILT / package, *content))
            (BUILT / f"{name}.js").write_text(text)
        (BUILT / "robots.js").write_text(script("robots", robots()))
    except (ImportError, ValueError) as error:  # the site is built without
        sys.exit(f"docs: the page Try it here cannot run anything: {error}")


if __name__ == "__main__":
    main()
