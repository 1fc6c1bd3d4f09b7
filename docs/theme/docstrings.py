r"""Docstrings as Markdown, for the API page: formulas as $...$, doctests in fences, options."""

import pydoc
import re
import textwrap

from griffe import Extension, Parameter, ParameterKind

from afm_rl.options import options_of, with_arguments

ROLE = re.compile(r":(?:class|func|meth|attr|mod|data):`~?(?:[\w.]+\.)?(\w+)`")
MATH = re.compile(r":math:`([^`]+)`", re.DOTALL)
FORMULA = re.compile(r"^( *)\.\. math::(.*(?:\n(?:\1 +.*| *$))*)", re.MULTILINE)
DOCTEST = re.compile(r"^( *)>>> .*(?:\n\1\S.*)*", re.MULTILINE)


def block(before: str, text: str, after: str, indent: str) -> str:
    """Return text between two lines, indented."""
    return textwrap.indent(f"\n{before}\n{text.strip()}\n{after}\n", indent)


def as_markdown(text: str) -> str:
    """Translate what docstrings here hold of reStructuredText."""
    text = ROLE.sub(r"`\1`", text)
    text = MATH.sub(lambda found: f"${' '.join(found[1].split())}$", text)
    text = FORMULA.sub(lambda m: block("$$", textwrap.dedent(f" {m[2]}"), "$$", m[1]), text)
    return DOCTEST.sub(lambda m: block("```pycon", textwrap.dedent(m[0]), "```", m[1]), text)


class Docstrings(Extension):
    """Translates each docstring before it is parsed; options join the other arguments."""

    def on_object(self, *, obj, **kwargs) -> None:
        taking = obj.members.get("__init__") if obj.is_class else obj
        known = {}
        if any("options(" in str(each.value) for each in getattr(taking, "decorators", ())):
            known = options_of(pydoc.locate(obj.path))
            for name, each in known.items():
                if name not in taking.parameters:  # one of a base
                    kind = ParameterKind.keyword_only
                    taking.parameters.add(Parameter(name, kind=kind, default="None"))
                if taking.parameters[name].default is not None:
                    taking.parameters[name].default = str(each.default)
        if obj.docstring:
            text = with_arguments(obj.docstring.value, known)
            obj.docstring.value = as_markdown(text)
