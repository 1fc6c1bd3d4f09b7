"""Write the table of all arguments on the page of a policy, as options and docstrings have them.

python docs/theme/arguments.py
"""

import re
from collections.abc import Iterator
from inspect import cleandoc, signature
from pathlib import Path

from afm_rl import ActionFlowWrapper
from afm_rl.correction import ActionFlow
from afm_rl.options import options_of
from afm_rl.transforms.loop_options import LoopOptions

PAGE = Path(__file__).resolve().parents[1] / "howto" / "my_policy.md"
TABLE = re.compile(r"(?<=<!-- arguments -->\n).*?(?=<!-- end -->)", re.DOTALL)
ROLE = re.compile(r":\w+:`~?(?:[\w.]+\.)?(\w+)`")


def rows() -> Iterator[str]:
    """Yield a line for each argument: name, default and what it is."""
    taking = signature(ActionFlowWrapper).parameters
    arguments = cleandoc(ActionFlowWrapper.__doc__ or "").split("\nArgs:\n")[1].split("\n\n")[0]
    for name, text in re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", arguments, re.MULTILINE)[1:]:
        about = ROLE.sub(r"`\1`", " ".join(text.split())).replace("``", "`").partition(". ")[0]
        yield f"| `{name}={taking[name].default!r}` | {about.rstrip('.')} |\n"
    for title, taker in (("of the loop", LoopOptions), ("of `ActionFlow`", ActionFlow)):
        yield f"| *{title}* | |\n"
        for name, option in options_of(taker).items():
            yield f"| `{name}={option.default!r}` | {option.text} |\n"


def page() -> str:
    """Return the page with the table of today."""
    table = "".join(["| argument | what it is |\n|---|---|\n", *rows()])
    return TABLE.sub(lambda _: table, PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
