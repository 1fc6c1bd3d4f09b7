"""What needs training is trained once, and taken from the cache ever after."""

import os
import shutil

import pytest
import torch
from harness import assert_same_results, composed

from afm_rl.errors import ConfigurationError
from afm_rl.missions import build, prepare, run
from afm_rl.missions.build import TRAINED
from afm_rl.storage.artefacts import read_tensors

METHOD = "method=afm_paper"  # trains an ensemble, and a flow over it


@pytest.fixture
def prepared(configure):
    """Build and prepare; return the agent and what was said."""

    def make(cache, *overrides, **settings):
        agent, lines = build(configure(METHOD, *overrides, **settings)), []
        prepare(agent, cache, echo=lines.append)
        return agent, [line for line in lines if "held-out error" in line]

    return make


def test_only_what_the_result_depends_on_is_part_of_the_key(prepared, cache):
    prepared(cache)
    _, lines = prepared(cache, "planner=mppi_paper", "seeds=3", budget=3)
    assert all("from the cache" in line for line in lines)
    after = {f"corrector.{name}": value for name, value in {"gate": 9.0, "steps": 2}.items()}
    after["dynamics.propagation"] = "sample"
    _, lines = prepared(cache, **after)
    assert all("from the cache" in line for line in lines)
    _, lines = prepared(cache, **{"corrector.train.iterations": 21})
    assert ["from the cache" in line for line in lines] == [True, False]
    _, lines = prepared(cache, **{"dynamics.seed": 1})
    assert not any("from the cache" in line for line in lines)


def test_the_ensemble_of_the_first_command_comes_with_the_library(tmp_path):
    """``RENEW=1 pytest`` trains it again, in a minute: after each change of what it depends on."""
    agent, lines, own = build(composed("method=online_pe")), [], TRAINED / "ensemble.safetensors"
    if os.environ.get("RENEW"):
        own.unlink(missing_ok=True)
        prepare(agent, tmp_path / "new")
        shutil.copy(next((tmp_path / "new").glob("ensemble-*")), own)
    prepare(agent, tmp_path, echo=lines.append)
    assert lines[0].startswith("ensemble: held-out error 0.003")
    assert lines[0].endswith("(as it comes)")
    assert torch.equal(agent.model.weights[0], read_tensors(own)[0]["weights.0"])
    lines.clear()
    prepare(agent, tmp_path, echo=lines.append)
    assert "(from the cache)" in lines[0]
    other = composed("method=online_pe", "dynamics.hidden=[8]", "dynamics.pretrain.epochs=1")
    prepare(build(other), tmp_path, echo=lines.append)
    assert "(trained in" in lines[2]


def test_a_cache_that_cannot_be_written_is_refused_first(prepared, tmp_path, no_training):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="file/below: .*Not a directory"):
        prepared(tmp_path / "file" / "below")


def test_a_home_folder_may_be_meant(prepared, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    prepared("~/parts")
    assert len(list((tmp_path / "parts").glob("[!.]*"))) == 2


def test_nothing_to_train_needs_no_cache(configure, no_training):
    prepare(build(configure("method=physics")), "/dev/null/nowhere")


def test_progress_is_shown_if_asked_for(configure, tmp_path):
    seen = []
    agent = build(configure("method=afm_paper", "dynamics=physics", "updater=frozen"))
    agent.trainings = [
        part._replace(train=lambda progress: seen.append(progress) or 0.5)
        for part in agent.trainings
    ]
    prepare(agent, tmp_path, progress=True, echo=seen.append)
    assert seen == [True, "flow: held-out error 0.5000 action units (trained in 0 s)"]


def test_nothing_changes_where_nothing_changed(make_agent, ring):
    settings = {"tracks": [ring], "regimes": "none", "seeds": 2, "budget": 20}
    assert_same_results(
        *(run(make_agent(f"method={name}", **settings)) for name in ("rls", "physics")), "method"
    )


@pytest.mark.parametrize("method", ["rls", "oracle"])
def test_an_ensemble_is_trained_once_whatever_is_in_front_of_it(configure, method):
    parts = [f"method={method}", "dynamics@dynamics.base=pe"], ["method=frozen_pe"]
    cfg = [configure(*chosen) for chosen in parts]
    one, other = ([(t.title, t.settings) for t in build(c).trainings] for c in cfg)
    assert one == other and len(one) == 1
