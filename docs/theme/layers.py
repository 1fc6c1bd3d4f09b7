"""The floors of the package, and the imports between its rooms, as a picture.

`python docs/theme/layers.py > layers.svg` draws it; the site draws it again each time it is built.
"""

import ast
from functools import cache
from pathlib import Path

import networkx as nx

ROOT = Path(__file__).resolve().parents[2]

# From the top to the bottom, each room with the column in which it is drawn. A room may import
# from the floors below its own. The foundations are the modules of afm_rl that are in no folder.
FLOORS = [
    {"cli": 2},
    {"jobs": 2, "comparison": 4},
    {"play": 0, "missions": 2, "report": 4},
    {"envs": 0, "transforms": 2},
    {"diagnosis": 4},
    {"correction": 2, "planning": 3},
    {"learning": 2},
    {"dynamics": 2},
    {"regimes": 2},
    {"spaces": 2},
    {"compiling": 3},
    {"storage": 4},
    {"foundations": 2},
]

WIDTH, HEIGHT, STEP, GAP, TRUNK = 112, 34, 66, 20, 320
STYLE = (
    "<style>rect{fill:#e8eaf6;stroke:#3f51b5}.arrow{fill:none;stroke:#607d8b;stroke-width:1.4}"
    "text{font:15px sans-serif;text-anchor:middle;fill:#1a237e}</style>"
    '<defs><marker id="head" viewBox="0 0 6 6" refX="3" refY="3" markerWidth="8" markerHeight="8" '
    'orient="auto" markerUnits="userSpaceOnUse"><path d="M0,0L6,3L0,6z" fill="#607d8b"/></marker>'
    "</defs>"
)


def room(module: str) -> str:
    """Return the room of a module, given by its full name."""
    rooms = [name for floor in FLOORS for name in floor]
    name = module.split(".")[1] if "." in module else ""
    name = {"__main__": "cli"}.get(name, name)
    return name if name in rooms else "foundations"


def files() -> dict[str, Path]:
    """Return the file of each module and package, by its full name."""
    return {
        ".".join([prefix, *path.relative_to(ROOT / top).with_suffix("").parts]).removesuffix(
            ".__init__"
        ): path
        for top, prefix in (("afm_rl", "afm_rl"), ("envs", "afm_rl.envs"))
        for path in sorted((ROOT / top).rglob("*.py"))
    }


@cache
def imported(path: Path) -> set[str]:
    """Return what of ours a file imports, by full names; also within functions and for types."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    plain = {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    taken = {
        f"{node.module}.{name.name}"
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    return {name for name in plain | taken if name.startswith("afm_rl.")}


def imports() -> dict[tuple[str, str], list[str]]:
    """Find the files of each room that import from another, {(from, to): paths}."""
    found: dict[tuple[str, str], list[str]] = {}
    for module, path in files().items():
        for other in {room(name) for name in imported(path)} - {room(module)}:
            found.setdefault((room(module), other), []).append(str(path.relative_to(ROOT)))
    return found


def circles() -> list[list[str]]:
    """Find modules that import each other, directly or through others."""
    modules = files()
    handed_on = {  # by packages that load lazily: a name, and the module that has it
        f"{package}.{name.name}": f"{package}.{node.module}"
        for package, path in modules.items()
        if path.with_suffix(".pyi").exists()
        for node in ast.parse(path.with_suffix(".pyi").read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    pairs = nx.DiGraph()
    for module, path in modules.items():
        for name in imported(path):
            while name in handed_on:
                name = f"{handed_on[name]}.{name.rpartition('.')[2]}"
            pairs.add_edge(module, name if name in modules else name.rpartition(".")[0])
    return [sorted(ring) for ring in nx.strongly_connected_components(pairs) if len(ring) > 1]


def floor_of(name: str) -> int:
    """Return the floor of a room, 0 at the top."""
    return next(number for number, rooms in enumerate(FLOORS) if name in rooms)


def essential(pairs: set) -> set:
    """Leave out the pairs that follow from others: a to c, where a leads to b and b to c."""
    return set(nx.transitive_reduction(nx.DiGraph(pairs)).edges)


def draw() -> str:
    """Return the picture, as SVG."""
    places = {
        name: (TRUNK + 120 * (column - 2), 30 + STEP * floor)
        for floor, rooms in enumerate(FLOORS)
        for name, column in rooms.items()
    }
    shapes = []
    for source, target in sorted(essential(set(imports()))):
        (x, y), (to_x, to_y) = places[source], places[target]
        start, end = y + HEIGHT / 2, to_y - HEIGHT / 2 - 4
        if to_x == TRUNK:  # down first, then sideways; and the other way round
            curve = f"L{x},{end - GAP} C{x},{end} {to_x},{end - GAP} {to_x},{end}"
        else:
            curve = f"C{x},{start + GAP} {to_x},{start} {to_x},{start + GAP} L{to_x},{end}"
        curve = f"M{x},{start} {curve}"
        shapes.append(f'<path d="{curve}" class="arrow" marker-end="url(#head)"/>')
    for name, (x, y) in places.items():
        box = f'x="{x - WIDTH / 2}" y="{y - HEIGHT / 2}" width="{WIDTH}" height="{HEIGHT}"'
        shapes.append(f'<rect {box} rx="6"/><text x="{x}" y="{y + 5}">{name}</text>')
    size = f'viewBox="0 0 640 {STEP * len(FLOORS) - 18}" width="640"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{STYLE}{"".join(shapes)}</svg>\n'


if __name__ == "__main__":
    print(draw(), end="")
