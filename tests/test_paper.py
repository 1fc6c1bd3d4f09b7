"""The page on the paper's agent: what it names is there, and the preset is what it states."""

import re

import pytest
import yaml
from harness import composed
from omegaconf import OmegaConf
from pages import DOCS, ROOT

PAGE = DOCS / "paper_agent.md"
PARTS = ("cost", "planner", "dynamics", "updater", "corrector")
OURS = {  # keys that the paper has nothing to say of
    *("_target_", "_partial_", "seed", "seed_key", "precision"),
    *("enabled", "max_correction", "max_correction_rate", "extend_effect_bounds", "checkpoint"),
}
OPTIMISER = "updater.optimizer._target_"


ELEMENTS = re.findall(
    r"^\| ([^|]+) \| `([\w/.]+\.py)::([\w.]+)` \| `(tests/[\w/.]+\.py)::(\w+)` \|$",
    PAGE.read_text(encoding="utf-8"),
    re.MULTILINE,
)
ROWS = re.findall(
    r"^\| `(?:(method=\w+) )?([\w.]+)` \| `(.+)` \| (.*) \| .*\|$",
    PAGE.read_text(encoding="utf-8"),
    re.MULTILINE,
)
SETTINGS = [(method or None, key, yaml.safe_load(value)) for method, key, value, _ in ROWS]
SOURCE = re.compile(r"\b(IV-[BC]|V-[BCD]|tables?|appendix|code|no source)\b")


@pytest.mark.parametrize("row", ELEMENTS, ids=lambda row: row[0])
def test_every_element_has_a_place_and_a_test(row):
    _, path, name, tested_in, test = row
    code = (ROOT / path).read_text(encoding="utf-8")
    for part in name.split("."):
        assert re.search(rf"(def|class) {part}\b", code), (name, path)
    assert re.search(rf"^def {test}\(", (ROOT / tested_in).read_text(encoding="utf-8"), re.M)


def test_the_page_has_what_it_is_for():
    assert len(ELEMENTS) >= 25 and len(SETTINGS) >= 35
    assert [row for row in ROWS if not SOURCE.search(row[3])] == []


@pytest.mark.parametrize(("method", "key", "value"), SETTINGS)
def test_the_preset_is_what_the_paper_states(method, key, value):
    found = OmegaConf.select(composed("agent=paper", *([method] if method else [])), key)
    found = OmegaConf.to_container(found) if OmegaConf.is_config(found) else found
    assert found == (float(value) if isinstance(found, float) else value)


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


def test_physics_needs_nothing_of_the_preset_but_planner_and_cost():
    whole, parts = (
        OmegaConf.to_container(composed(*choices, "method=physics"), resolve=True)
        for choices in (["agent=paper"], ["planner=mppi_paper", "cost=goal_pose"])
    )
    assert whole == parts


@pytest.mark.slow
def test_the_study_runs_the_preset():
    study = composed("study=ugv_paper")
    for method in study.compare:
        one, alone = (
            composed(choice, f"method={method}") for choice in ("study=ugv_paper", "agent=paper")
        )
        assert all(one[part] == alone[part] for part in PARTS)
    assert {"afm_paper", "afm_paper_code", "afm_dr", "online_pe"} <= set(study.compare)
