"""Store the outcome of the slow tests as a result: benchmarks/results/nightly.json.

python benchmarks/nightly.py build/nightly.xml  # after pytest -m slow --junitxml=...
"""

from __future__ import annotations

import sys
from xml.etree import ElementTree

from results import commit, fill_pages, save, surroundings


def main() -> None:
    """Read JUnit's report; write the counts, with commit, versions, machine and seconds."""
    (suite,) = ElementTree.parse(sys.argv[1]).getroot()
    failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
    skipped = int(suite.get("skipped", 0))
    passed = int(suite.get("tests", 0)) - failed - skipped
    result = {
        "commands": ["make nightly"],
        "seeds": "those of the tests",
        "figures": [],
        "tables": {
            "tests": [
                "| passed | skipped | failed |",
                "|---|---|---|",
                f"| {passed} | {skipped} | {failed} |",
            ]
        },
        "commit": commit(),
    }
    save("nightly", result | surroundings() | {"seconds": round(float(suite.get("time", 0)))})
    fill_pages()  # one of them counts the results
    print(f"nightly: {passed} passed, {skipped} skipped, {failed} failed; stored")


if __name__ == "__main__":
    main()
