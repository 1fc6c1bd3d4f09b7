"""The page on TorchRL runs from top to bottom."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "torchrl.md"


@pytest.mark.filterwarnings("ignore")
def test_the_page_runs():
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(blocks) > 5
    exec(compile("\n".join(blocks), str(PAGE), "exec"), {"__name__": "page"})


def test_files_that_are_linked_exist():
    links = re.findall(r"\]\(([^)#:]+)\)", PAGE.read_text())
    assert links and all((PAGE.parent / link).exists() for link in links)
