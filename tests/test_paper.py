"""The page on the paper: what it names is there, and the preset is what it states."""

import re

import pytest
import yaml
from harness import composed
from omegaconf import OmegaConf
from pages import DOCS, ROOT

PAGE = (DOCS / "paper.md").read_text(encoding="utf-8")
PARTS = ("cost", "planner", "dynamics", "updater", "corrector")
OURS = {  # keys that the paper has nothing to say of
    *("_target_", "_partial_", "seed", "seed_key", "precision"),
    *("enabled", "most", "rate", "extend_action_box", "checkpoint"),
}
OPTIMISER = "updater.optimizer._target_"


def rows(columns):
    """Return the cells of the rows of tables with so many columns, without their heads."""
    lines = [line for line in PAGE.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    return [each for each in cells if len(each) == columns and "`" in each[1]]


ELEMENTS = rows(4)
SETTINGS = [
    (*re.fullmatch(r"`(?:(method=\w+) )?([\w.]+)`", key).groups(), value)
    for _, key, value in rows(3)
]


@pytest.mark.parametrize("row", ELEMENTS, ids=lambda row: row[0])
def test_every_element_has_a_place_and_a_test(row):
    (name, path), (tested_in, test) = (
        re.fullmatch(r"`([\w.]+)` in `([\w/.]+\.py)`", row[1]).groups(),
        re.fullmatch(r"`(tests/[\w/.]+\.py)::(\w+)`", row[2]).groups(),
    )
    code = (ROOT / path).read_text(encoding="utf-8")
    for part in name.split("."):
        assert re.search(rf"(def|class) {part}\b", code), (name, path)
    assert re.search(rf"^def {test}\(", (ROOT / tested_in).read_text(encoding="utf-8"), re.M)
    assert row[3].startswith(("yes", "differs", "a [reading]"))


def test_the_page_has_what_it_is_for():
    assert len(ELEMENTS) >= 25 and len(SETTINGS) >= 35


@pytest.mark.parametrize(("method", "key", "value"), SETTINGS)
def test_the_preset_is_what_the_paper_states(method, key, value):
    found = OmegaConf.select(composed("agent=paper", *([method] if method else [])), key)
    found = OmegaConf.to_container(found) if OmegaConf.is_config(found) else found
    stated = yaml.safe_load(value)
    assert found == (float(stated) if isinstance(found, float) else stated)


def test_no_setting_of_the_preset_is_left_unsaid():
    def leaves(node, path):
        for key, value in node.items():
            if isinstance(value, dict):
                yield from leaves(value, f"{path}.{key}")
            elif key not in OURS:
                yield f"{path}.{key}"

    settings = OmegaConf.to_container(composed("agent=paper"), resolve=True)
    wanted = {leaf for part in PARTS for leaf in leaves(settings[part], part)} | {OPTIMISER}
    assert wanted == {key for method, key, _ in SETTINGS if method is None}


def test_the_study_runs_the_preset():
    study = composed("study=ugv_paper")
    for method in study.compare:
        one, alone = (
            composed(choice, f"method={method}") for choice in ("study=ugv_paper", "agent=paper")
        )
        assert all(one[part] == alone[part] for part in PARTS)
    assert {"afm_paper", "afm_paper_code", "afm_dr", "online_pe"} <= set(study.compare)
