"""Our groups in a configuration of somebody else's."""

import hydra
import pytest
from hydra import compose, initialize_config_dir

from afm_rl.missions import build

APPLICATION = """
defaults:
  - cost: goal_position
  - planner: mppi
  - dynamics: physics
  - updater: frozen
  - corrector: none
  - _self_
  - robot: ugv
tracks: ethz_1
regimes: none
mine: {anything: 3}
hydra:
  searchpath: ["pkg://afm_rl.conf"]
"""


@pytest.fixture
def there(tmp_path):
    (tmp_path / "config.yaml").write_text(APPLICATION)

    def make(*overrides):
        with initialize_config_dir(str(tmp_path), version_base="1.3"):
            return compose("config", list(overrides))

    return make


@pytest.mark.parametrize(
    ("overrides", "label"),
    [
        ([], "physics"),
        (["corrector=adaptive_gain"], "physics+least_squares"),
        (["+method=afm_physics"], "physics+afm"),
        (["+method=rls"], "calibrated+RLSUpdater"),
    ],
    ids=str,
)
def test_groups_and_presets_build_an_agent(there, overrides, label):
    agent = build(there(*overrides))
    assert (agent.label, len(agent.missions)) == (label, 1)
    assert (agent.transform is None) == (overrides in ([], ["+method=rls"]))


def test_a_command_of_somebody_else_s_names_the_method_that_it_chose(there, tmp_path, monkeypatch):
    there()
    monkeypatch.setattr("sys.argv", ["app", "+method=rls", f"hydra.run.dir={tmp_path}/run"])
    labels = []
    app = hydra.main(version_base="1.3", config_path=str(tmp_path), config_name="config")
    app(lambda cfg: labels.append(build(cfg).label))()
    assert labels == ["rls"]
