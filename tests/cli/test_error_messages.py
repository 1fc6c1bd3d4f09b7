"""Settings that cannot be used: one line that names them, before anything is trained."""

import pytest
import torch

from afm_rl.cli.error_messages import explain, one_line
from afm_rl.correction import ActionFlow
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI

CASES = {  # overrides, and what the line must name
    "method=nope": "method/nope afm_physics",
    "method=physics +planner.horizn=3": "planner: horizn",
    "method=physics seeds=[1": "[1",
    "method=physics budget=0": "budget=0",
    "method=physics budget=${nope}": "nope",
    "method=physics threads=0": "threads=0",
    "method=physics overwrite=perhaps": "overwrite='perhaps'",
    "method=physics ~tensorboard": "tensorboard",
    "method=physics checkpoints.every=soon": "checkpoints.every='soon'",
    "hydra.launcher.n_jobs=0": "hydra.launcher.n_jobs=0",
    "study=nope": "study/nope",
    "study=ugv study.workers=1": "study.workers",
    "method=physics cache=null": "cache=None",
    "compare=[nope]": "method/nope afm_physics",
    "compare=physics": "compare=physics",
    "compare=[physics,physics]": "compare=",
    "method=physics tracks=missing.csv": "tracks missing.csv",
    "method=afm_paper +corrector.train.step=1": "corrector.train 'step' iterations",
    "method=afm_paper corrector.checkpoint=missing": "corrector.checkpoint missing",
}


@pytest.fixture
def refuse(afm_rl, tmp_path, quick, monkeypatch):
    """Call the command line with settings that it must refuse; return its one line."""

    def never(*args, **kwargs):
        raise AssertionError("went on, though the settings cannot be used")

    monkeypatch.setattr("afm_rl.missions.factories.Training.train", never)
    monkeypatch.setattr("afm_rl.cli.launch._run_here", never)

    def call(*overrides):
        given = {override.partition("=")[0].lstrip("+~") for override in overrides}
        extra = [text for text in quick if text.partition("=")[0] not in given]
        folder = [] if "hydra.run.dir" in given else [f"hydra.run.dir={tmp_path}/run"]
        done = afm_rl(*extra, *folder, *overrides)
        assert done.status == 2
        assert done.out == ""
        assert done.err.startswith("afm-rl: ") and done.err.count("\n") == 1, done.err
        assert not any((tmp_path / "run").glob("*"))
        return done.err

    return call


@pytest.mark.parametrize("overrides", CASES)
def test_a_setting_that_cannot_be_used(refuse, overrides):
    line = refuse(*overrides.split())
    assert all(word in line for word in CASES[overrides].split()), line


def test_a_track_that_cannot_be_used(refuse, tmp_path):
    (tmp_path / "my_track.csv").write_text("x,y\n0,0\n1,one\n")
    line = refuse("method=physics", f"tracks={tmp_path}/my_track.csv")
    assert "tracks" in line and "my_track" in line and "line 3: 'one' is not a finite" in line


def test_a_folder_that_cannot_be_written(refuse, tmp_path):
    (tmp_path / "file").write_text("")
    line = refuse("method=physics", f"hydra.run.dir={tmp_path}/file/run")
    assert line == f"afm-rl: {tmp_path}/file/run: Not a directory\n"


@pytest.mark.slow
def test_a_package_is_trusted_on_the_command_line_alone(refuse, monkeypatch, tmp_path):
    (tmp_path / "mine.py").write_text("from os import system\ndef made(): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    target = "planner._target_=mine.made"
    assert "planner._target_='mine.made': only parts of afm_rl" in refuse(target)
    assert "planner: made() got an unexpected" in refuse(target, "trust=[mine]")
    line = refuse("trust=[mine]", "planner._target_=mine.system")
    assert "is code of posix" in line  # trusted is what the package defines
    assert refuse("trust=mine").startswith("afm-rl: trust='mine': expected a list of names")


@pytest.mark.slow
def test_a_misspelt_setting_suggests_the_nearest_one(refuse):
    table = {
        "planner.horizn=3": "did you mean planner.horizon?",
        "planer=cem": "did you mean planner?",
        "method=afm_physics corrector.nois=3": "did you mean corrector.noise?",
        "method=physics horizon=3": "did you mean planner.horizon?",
        "xyzxyz=3": "afm-rl --cfg job shows all settings",
    }
    for overrides, advice in table.items():
        assert refuse(*overrides.split()).endswith(f": there is no such setting; {advice}\n")


def test_a_setting_by_its_old_name_says_the_new_one(refuse):
    line = refuse("method=physics", "planner.population=16")
    assert line == "afm-rl: planner.population is now called planner.candidates\n"
    with pytest.raises(ConfigurationError, match=r"planner.population is now called planner.can"):
        MPPI(None, population=16)


def test_a_setting_that_is_gone_says_why(refuse):
    gone = {
        "corrector.hypotheses=[newest]": "the table of hypotheses is the same for all",
        "core=c": "the corrector is computed by torch alone",
    }
    for override, words in gone.items():
        line = refuse("method=afm_physics", override)
        assert line.startswith(f"afm-rl: {override.partition('=')[0]} is gone: {words}")
    with pytest.raises(ConfigurationError, match="^corrector.samples is gone: the corrector is a "):
        ActionFlow(-torch.ones(1), torch.ones(1), samples=3)
    with pytest.raises(ConfigurationError, match="names are gone, because the table is the same"):
        ActionFlow(-torch.ones(1), torch.ones(1), hypotheses=["newest"])


def test_yaml_tags_are_not_followed(refuse, tmp_path):
    canary = tmp_path / "canary"
    text = f"label: !!python/object/apply:os.system ['touch {canary}']\n"
    (tmp_path / "evil.yaml").write_text(text)
    line = refuse(f"--config-path={tmp_path}", "--config-name=evil")
    assert "could not determine a constructor" in line and "evil.yaml" in line
    assert not canary.exists()


def test_what_is_no_mistake_is_not_explained():
    assert explain(OSError("no number")) is None
    assert explain(OSError(28, "No space left on device")) == "files: No space left on device"
    wrapped = RuntimeError("outer")
    wrapped.__context__ = ConfigurationError("budget=0:\n  expected more")
    assert explain(wrapped) == "budget=0: expected more"


def test_advice_of_hydra_is_left_out():
    assert one_line("Wrong\nSee https://example.org/a/b for details") == "Wrong"
