"""The command line as people start it: in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import afm_rl.conf

CONF = Path(afm_rl.conf.__file__).parent
PROGRAM = str(Path(sys.executable).with_name("afm-rl"))
STUDY = "method=afm_physics tracks=all regimes=paper seeds=5 planner=mppi_paper cost=goal_pose"


def process(*command, **settings):
    return subprocess.run(command, capture_output=True, text=True, **settings)


@pytest.mark.slow
def test_the_paper_s_study_is_one_line(tmp_path, quick):
    small = [*quick, "budget=3"]
    done = process(PROGRAM, *STUDY.split(), "hydra.run.dir=study", *small, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    missions = pd.read_csv(tmp_path / "study" / "missions.csv")
    assert len(missions) == 110
    assert not missions.duplicated(["track", "v_gain", "omega_gain", "seed"]).any()
    assert missions.groupby("track").size().to_dict() == {"ethz_1": 55, "ethz_2": 55}


def test_help_lists_groups_and_choices_and_needs_no_torch():
    code = "import sys, afm_rl.cli; afm_rl.cli.main(); assert 'torch' not in sys.modules"
    done = process(sys.executable, "-c", code, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    for group in ("planner", "cost", "robot", "corrector", "tune"):
        choices = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        assert f"{group}: {', '.join(choices)}\n" in done.stdout
    assert "afm_physics" in done.stdout and "seeds" in done.stdout


def test_a_reader_that_has_seen_enough_is_no_error():
    with subprocess.Popen(
        [PROGRAM, "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        running.stdout.close()
        said = running.stderr.read()
    assert running.returncode == 1
    assert said == ""
