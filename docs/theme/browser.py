"""What the page needs that runs the exported file: onnxruntime-web and the file, as one script."""

import base64
import hashlib
import json
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
POLICY = ROOT / "build" / "try" / "policy.onnx"  # both are made by `make docs`
RUNTIME = ROOT / "build" / "try" / "onnxruntime-web-1.30.0.tgz"
CHECKSUM = (  # SHA-512 of the package, as it was when this page was tested
    "ab4cbe26baedba45d2cec05610c71c55fa97db92d19a8b171c5f8269126683ca"
    "590a5cdc57bb2f35ce2b298de32f4d956fb42644c0ecd528a0a91e025c07ca61"
)
PARTS = {"module": "ort-wasm-simd-threaded.mjs", "wasm": "ort-wasm-simd-threaded.wasm"}


def script(policy=POLICY, runtime=RUNTIME):
    """Return the script.

    Raises:
        ValueError: with a line that says what is missing.
    """
    for file in (policy, runtime):
        if not file.is_file():
            raise ValueError(f"{file.name} is missing: `make docs` brings it in, by npm and onnx")
    if hashlib.sha512(runtime.read_bytes()).hexdigest() != CHECKSUM:
        raise ValueError(f"{runtime}: another checksum than the one in {Path(__file__).name}")
    with tarfile.open(runtime) as package:
        content = {
            name: package.extractfile(f"package/dist/{file}").read()
            for name, file in (PARTS | {"ort": "ort.wasm.min.js"}).items()
        }
    ort = content.pop("ort").decode()
    coded = {name: base64.b64encode(data).decode() for name, data in content.items()}
    coded["policy"] = base64.b64encode(policy.read_bytes()).decode()
    return f"{ort}\nconst RUNTIME = {json.dumps(coded)};\n"
