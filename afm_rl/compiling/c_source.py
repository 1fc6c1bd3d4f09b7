"""An ONNX graph as C99, for one robot at a time: no heap, no state, little stack.

The package emx-onnx-cgen writes one C function for each node of the graph, and one that calls them
with a buffer for each result. Here that one is written anew: buffers that are never needed at the
same time share a workspace that the caller brings, and of a branch only the side that is taken is
computed.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

BYTES = {"bool": 1, "float": 4, "double": 8, "int32_t": 4, "int64_t": 8}
ALIGNED = 64  # bytes: a line of the processor's cache
BUFFER = re.compile(r"    (\w+) (\w+)((?:\[\d+\])+);$")
CALL = re.compile(r"    (node\d+_\w+)\((.*)\);$")
SIDE = re.compile(r"node\d+_(\w+)_(then|else)_\w+$")
ARGUMENT = re.compile(r"(const )?(\w+) (\w+)((?:\[[\w ]+\])+)$")


class Buffer(NamedTuple):
    """An array of the C code."""

    kind: str
    """Type of its numbers."""
    shape: list[int]
    """How many there are, by dimension."""

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        length = BYTES[self.kind] * math.prod(self.shape)
        return -(-length // ALIGNED) * ALIGNED

    def at(self, name: str, offset: int) -> str:
        """Return the C that names a place in the workspace."""
        rows = "".join(f"[{size}]" for size in self.shape[1:])
        pointer = f"(*const {name}){rows}" if rows else f"*const {name}"
        return f"    {self.kind} {pointer} = (void *)(workspace + {offset});"


class Step(NamedTuple):
    """A call of a node's function."""

    function: str
    arguments: list[str]

    @property
    def side(self) -> tuple[str, str] | None:
        """The branch that it belongs to, and which side of it; None: neither."""
        found = SIDE.match(self.function)
        return None if found is None else (found[1], found[2])


def as_c(graph: bytes, name: str) -> str:
    """Return a graph as C.

    Its function ``NAME`` takes a number of robots, arrays of inputs and outputs with a row for each
    robot, and a workspace of ``NAME_workspace`` bytes, aligned to 64.

    Raises:
        CalledProcessError: for a graph with operations that emx-onnx-cgen does not know.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "graph.onnx"
        path.write_bytes(graph)
        options = ["--large-temp-threshold", "0", "--large-weight-threshold", str(2**31)]
        run = [sys.executable, "-m", "emx_onnx_cgen", "compile", *options, "--model-name", "node"]
        subprocess.run(
            [*run, str(path), str(path.with_suffix(".c"))], capture_output=True, check=True
        )
        code = path.with_suffix(".c").read_text()
    begin = code.rindex("\nvoid node(") + 1
    code = f"#include <stddef.h>\n{code[:begin]}{_function(code[begin:], name)}"
    return code.replace("node_load", f"{name}_load")  # which is no static function


def as_header(code: str, name: str, meanings: Mapping[str, str]) -> str:
    """Return the header of what :func:`as_c` wrote, which says what each argument means."""
    declared = next(line for line in code.splitlines() if line.startswith(f"void {name}("))
    sizes = dict(re.findall(r"\((\w+) \+ robot \* (\d+)\)", code))
    about = "".join(f" * {key}, {size} per robot: {meanings[key]}\n" for key, size in sizes.items())
    numbers = ", ".join(f"{name}_{key} = {size}" for key, size in sizes.items())
    return f"""#ifndef {name.upper()}_H
#define {name.upper()}_H
#include <stdbool.h>
#include <stddef.h>
/* For so many robots. Rows of numbers, commands in shares of the largest action:
{about} * workspace: {name}_workspace bytes, aligned to {ALIGNED}; one for each thread */
{declared.removesuffix(" {")};
enum {{ {numbers} }};
extern const size_t {name}_workspace;
#endif
"""


def _function(code: str, name: str) -> str:
    """Return the function that calls those of the nodes, written anew."""
    head, *lines = code[: code.rindex("\n}")].split("\n")
    buffers = {
        found[2]: Buffer(found[1], _sizes(found[3])) for found in map(BUFFER.match, lines) if found
    }
    calls = [found for found in map(CALL.match, lines) if found]
    steps = [Step(found[1], found[2].split(", ")) for found in calls]
    places, size = _places(buffers, steps)
    inside = [buffers[buffer].at(buffer, offset) for buffer, offset in places.items()]
    branch: tuple[str, str] | None = None
    for number, step in enumerate(steps):
        if step.side != branch:
            inside += ["    }"] * (branch is not None)
            if step.side is not None:
                inside.append(f"    if ({_condition(steps[number:], *step.side)}) {{")
            branch = step.side
        inside.append(f"    {step.function}({', '.join(step.arguments)});")
    begin, end = head.index("("), head.rindex(")")
    one = f"static void {name}_one{head[begin:end]}, unsigned char *workspace) {{"
    return "\n".join([one, *inside, "}", "", _entry(name, head[begin + 1 : end], size)])


def _places(buffers: dict[str, Buffer], steps: list[Step]) -> tuple[dict[str, int], int]:
    """Return where in the workspace buffers lie, and its size: large ones first, none in another's.

    A buffer is needed from the step that writes it to the last one that reads it.
    """
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    for number, step in enumerate(steps):
        for name in buffers.keys() & set(step.arguments):
            first.setdefault(name, number)
            last[name] = number
    places: dict[str, int] = {}
    for name in sorted(first, key=lambda name: (-buffers[name].size, first[name])):
        together = [k for k in places if first[k] <= last[name] and first[name] <= last[k]]
        place = 0
        for begin, end in sorted((places[k], places[k] + buffers[k].size) for k in together):
            if place + buffers[name].size <= begin:
                break
            place = max(place, end)
        places[name] = place
    return places, max(place + buffers[name].size for name, place in places.items())


def _condition(steps: list[Step], branch: str, side: str) -> str:
    """Return when a side of a branch is taken: what chooses between the two is asked."""
    chooses = re.compile(rf"node\d+_{branch}_select_\d+$")
    asked = next(step.arguments[0] for step in steps if chooses.match(step.function))
    return f"{'' if side == 'then' else '!'}{asked}[0]"


def _entry(name: str, arguments: str, size: int) -> str:
    """Return the function for several robots, and the size of its workspace."""
    taken, passed = [], []
    for argument in arguments.split(", "):
        found = ARGUMENT.match(argument)
        if found is None:
            raise ValueError(f"{argument!r}: expected an array, as emx-onnx-cgen 1.4 writes them")
        taken.append(f"{found[1] or ''}{found[2]} *{found[3]}")
        length = math.prod(_sizes(found[4]))
        passed.append(f"(void *)({found[3]} + robot * {length})")
    return f"""const size_t {name}_workspace = {size};

void {name}(size_t robots, {", ".join(taken)}, void *workspace) {{
    for (size_t robot = 0; robot < robots; ++robot) {{
        {name}_one({", ".join(passed)}, workspace);
    }}
}}
"""


def _sizes(shape: str) -> list[int]:
    """Return the numbers in the brackets of an array."""
    return [int(size) for size in re.findall(r"\d+", shape)]
