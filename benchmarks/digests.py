"""Digests of files, of which those of Python and YAML come from what is written, not how.

Comments, docstrings, layout and the names of local variables do not count. Names that somebody
else can say or see do: those of arguments, attributes, functions, classes and modules.
"""

from __future__ import annotations

import ast
import hashlib
import subprocess
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import yaml

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
NAMED = {  # nodes that say a variable, and their field that does
    ast.Name: "id",
    ast.ExceptHandler: "name",
    ast.MatchAs: "name",
    ast.MatchStar: "name",
    ast.MatchMapping: "rest",
}
SEEING = {"dir", "eval", "exec", "locals", "vars"}  # who calls them sees names of local variables
Names = dict[str, str]  # what is written for a name: itself, or the number of a variable


@cache
def digest(file: Path) -> str:
    """Return what tells a file from another one; one that is absent is as an empty one."""
    return digest_of(file.read_bytes() if file.is_file() else b"", file.suffix)


def digest_of(content: bytes, suffix: str) -> str:
    r"""Return what tells the content of a file from another one.

    >>> a, b = b"def f(x):\n    y = x + 1\n    return y", b"def f(x): z = x + 1; return z  # new"
    >>> digest_of(a, ".py") == digest_of(b, ".py")
    True
    """
    if suffix in (".py", ".pyi"):
        tree = ast.parse(content)
        for node in ast.walk(tree):
            kinds = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
            if isinstance(node, kinds) and ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        number_locals(tree.body, {}, {}, map(str, count()))
        content = repr(plain(tree)).encode()
    elif suffix == ".yaml":
        content = repr(yaml.safe_load(content)).encode()
    return hashlib.sha256(content).hexdigest()


def plain(tree: Any) -> Any:
    """Return a syntax tree as lists that are the same in all versions of Python.

    Versions differ in fields that are empty here, and in how they write code out.
    """
    if isinstance(tree, ast.AST):
        fields = ((name, value) for name, value in ast.iter_fields(tree) if value not in (None, []))
        return [type(tree).__name__, *([name, plain(value)] for name, value in fields)]
    return [plain(item) for item in tree] if isinstance(tree, list) else repr(tree)


def number_locals(
    roots: Iterable[ast.AST], names: Names, names_within: Names, numbers: Iterator[str]
) -> None:
    """Write numbers in place of the names of local variables.

    Args:
        roots: What is evaluated in one scope.
        names: What is written in this scope.
        names_within: What is written in the scopes within it; they do not see the names of a class.
        numbers: What variables get that are bound within it.
    """
    for node in nodes_in(roots):
        field = NAMED.get(type(node), "")
        if name := getattr(node, field, None):
            setattr(node, field, names.get(name, name))
        elif isinstance(node, ast.Nonlocal):
            node.names[:] = [names.get(name, name) for name in node.names]
        elif inner := inside(node):
            visible = names_within | names_of(node, numbers)
            is_class = isinstance(node, ast.ClassDef)
            number_locals(inner, visible, names_within if is_class else visible, numbers)


def inside(node: ast.AST) -> list[ast.AST]:
    """Return those nodes under a node that are evaluated in a new scope, its own."""
    if isinstance(node, COMPREHENSIONS):
        first, *others = node.generators
        values = [node.key, node.value] if isinstance(node, ast.DictComp) else [node.elt]
        return [first.target, *first.ifs, *others, *values]
    if isinstance(node, ast.Lambda):
        return [node.body]
    return [*node.body] if isinstance(node, DEFINITIONS) else []


def nodes_in(roots: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Yield the nodes that are evaluated in the scope of some, not those of scopes within it."""
    for node in roots:
        yield node
        if isinstance(node, COMPREHENSIONS):  # := in them binds around them
            yield from nodes_in([node.generators[0].iter])
            yield from (n.target for n in ast.walk(node) if isinstance(n, ast.NamedExpr))
        else:
            inner = inside(node)
            yield from nodes_in(n for n in ast.iter_child_nodes(node) if n not in inner)


def names_of(node: ast.AST, numbers: Iterator[str]) -> Names:
    """Return what is written for the names that a function, class or comprehension binds."""
    if isinstance(node, COMPREHENSIONS):
        nodes = [n for generator in node.generators for n in nodes_in([generator.target])]
    else:
        nodes = [*nodes_in(inside(node))]
    bound = [n for n in nodes if not isinstance(getattr(n, "ctx", None), ast.Load)]
    variables = dict.fromkeys(getattr(n, NAMED.get(type(n), ""), None) for n in bound)
    used = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    seen = isinstance(node, ast.ClassDef) or SEEING & used
    names = {name: name if seen else next(numbers) for name in variables if name}
    for statement in nodes:
        match statement:
            case ast.Global(outer):
                names |= {name: name for name in outer}
            case ast.Nonlocal(outer):
                names = {name: names[name] for name in names if name not in outer}
            case ast.FunctionDef(name) | ast.AsyncFunctionDef(name) | ast.ClassDef(name):
                names[name] = name
            case ast.alias(name, alias):
                name = (alias or name).partition(".")[0]
                names[name] = name
    arguments = ast.iter_child_nodes(getattr(node, "args", node))
    return names | {a.arg: a.arg for a in arguments if isinstance(a, ast.arg)}


def git(root: Path, *arguments: str) -> list[str]:
    """Return the lines that git prints in a checkout."""
    return subprocess.check_output(["git", *arguments], cwd=root, text=True).splitlines()


def packed(code: dict[str, str]) -> dict[str, str]:
    """Return digests of files with a line for each folder.

    >>> packed({"a/b.py": "01", "a/c.py": "02"})
    {'a': 'b.py 01 c.py 02'}
    """
    folders: dict[str, str] = {}
    for file, value in code.items():
        folder, _, name = file.rpartition("/")
        folders[folder] = f"{folders.get(folder, '')} {name} {value}".lstrip()
    return folders


def unpacked(folders: dict[str, str]) -> dict[str, str]:
    """Return what was packed."""
    pairs = ((Path(folder), iter(text.split())) for folder, text in folders.items())
    return {
        (folder / name).as_posix(): value
        for folder, words in pairs
        for name, value in zip(words, words, strict=True)
    }
