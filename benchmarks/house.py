"""Count the house: files, lines, classes, module constants, words of docs, and what imports load.

    python benchmarks/house.py [ROOT]

Lines, classes and constants are those of ``afm_rl`` and ``envs``. A constant is a name in capitals
that a module assigns, once for each.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parents[1]
IMPORTS = {
    "ActionFlowTransform": "from afm_rl.transforms import ActionFlowTransform",
    "ActionFlowWrapper": "from afm_rl import ActionFlowWrapper",
}
FILES = """
import sys
print(*(m.__file__ for name, m in sys.modules.items() if name[:6] == "afm_rl"), sep="\\n")
"""


def constants(tree: ast.Module) -> int:
    """Return how many names in capitals a module assigns."""
    named = [
        name.id
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    ]
    return sum(name.lstrip("_").isupper() for name in named)


def count(root: Path) -> dict[str, int]:
    """Return what there is of each kind."""
    files = [path for top in ("afm_rl", "envs") for path in sorted((root / top).rglob("*.py"))]
    texts = [path.read_text(encoding="utf-8") for path in files]
    trees = [ast.parse(text) for text in texts]
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    return {
        "files": len(files),
        "lines": sum(text.count("\n") for text in texts),
        "classes": sum(isinstance(node, ast.ClassDef) for t in trees for node in ast.walk(t)),
        "module constants": sum(map(constants, trees)),
        "words of docs": sum(len(page.read_text(encoding="utf-8").split()) for page in pages),
    }


def loaded(statement: str) -> int:
    """Return how many lines of the package that is installed an import loads."""
    code = f"{statement}\n{FILES}"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return sum(Path(path).read_text(encoding="utf-8").count("\n") for path in ran.stdout.split())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, nargs="?", default=HERE)
    for name, number in count(parser.parse_args().root).items():
        print(f"{name}: {number:,}")
    for name, statement in IMPORTS.items():
        print(f"lines loaded by {name}: {loaded(statement):,}")


if __name__ == "__main__":
    main()
