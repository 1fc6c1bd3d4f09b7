"""Settings from a file run no code, however they are written."""

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from afm_rl.cli.overrides import checked
from afm_rl.jobs import executor
from afm_rl.trust import trusted

TARGETS = """
os.system shutil.copyfile logging.FileHandler pandas.eval numpy.savetxt multiprocessing.Process
""".split()
COPY = {"_target_": "shutil.copyfile", "src": "/etc/hostname", "dst": "canary"}
RULE = "a settings file must not have a key hydra; give it on the command line, or in the folder"
TO_HYDRA = [
    {"hydra.job.env_set.AFM_RL_TRUST": "x"},
    {"hydra.run.dir": "/"},
    {"hydra.callbacks.x": COPY},
    {"hydra": "${x}", "x": {"callbacks": {"x": COPY}}},
    {"hydra.callbacks.x": "${oc.create:'{_target_: os.system}'}"},
    {"hydra.searchpath": ["pkg://stranger"]},
]
"""Settings under the key."""
CALLBACK = "x: {_target_: shutil.copyfile, src: /etc/hostname, dst: canary}"
HEADER = "# @package hydra.callbacks\n"
ON_OTHER_WAYS = {
    "a header": ({"launcher/evil.yaml": HEADER + CALLBACK}, "launcher: evil"),
    "a folder": ({"hydra/callbacks/evil.yaml": CALLBACK}, "hydra/callbacks: evil"),
    "a place for a group": ({"x/evil.yaml": CALLBACK}, "x@hydra.callbacks: evil"),
    "a choice of Hydra's": ({}, "override hydra/job_logging: default"),
    "a merged mapping": ({}, "x: null", f"<<: {{hydra: {{callbacks: {{{CALLBACK}}}}}}}"),
}
"""Files beside one of settings, an entry of its defaults, and what else it says."""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write files of settings, and work in an empty folder from which modules come."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "__init__.py").write_text("open('canary', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)

    def make(settings, files=()):
        if not isinstance(settings, str):
            cfg = OmegaConf.create({"defaults": ["config", "_self_"]})
            for place, value in settings.items():
                OmegaConf.update(cfg, place, value, force_add=True)
            settings = OmegaConf.to_yaml(cfg)
        for name, text in {"evil.yaml": settings, **dict(files)}.items():
            (tmp_path / "conf" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "conf" / name).write_text(text)
        return ["--config-dir", tmp_path / "conf", "--config-name", "evil"]

    yield make
    assert not Path("canary").exists() and "stranger" not in sys.modules


@pytest.fixture
def refused(afm_rl):
    """Return the line in which a command ends before anything is run."""

    def give(*arguments):
        done = afm_rl(*arguments, "method=physics", "seeds=1,2", "-m")
        assert (done.status, done.out, done.err.count("\n")) == (2, "", 1)
        return done.err

    return give


@pytest.mark.parametrize("settings", TO_HYDRA, ids=str)
def test_a_file_says_nothing_to_hydra(write, refused, settings):
    assert RULE in refused(*write(settings))


@pytest.mark.parametrize("way", ON_OTHER_WAYS)
def test_nor_on_other_ways(write, refused, way):
    files, entry, *more = ON_OTHER_WAYS[way]
    text = "\n".join([f"defaults: [config, {{{entry}}}, _self_]", *more])
    assert RULE in refused(*write(text, files))


def test_whoever_names_a_package_trusts_what_it_says_to_hydra(afm_rl, write, tmp_path):
    own = write({"hydra.run.dir": str(tmp_path / "run")})
    (tmp_path / "boat").mkdir()
    (tmp_path / "boat" / "__init__.py").touch()
    (tmp_path / "conf").rename(tmp_path / "boat" / "conf")
    own[1] = tmp_path / "boat" / "conf"
    assert RULE in afm_rl(*own, "--cfg", "hydra").err
    done = afm_rl(*own, "trust=[boat]", "--cfg", "hydra", "-p", "hydra.run.dir")
    assert (done.status, done.err) == (0, "") and str(tmp_path / "run") in done.out


def test_what_takes_for_ever_to_read_is_refused(write, refused):
    pairs = "".join(f"x{n}: &x{n} [*x{n - 1}, *x{n - 1}]\n" for n in range(1, 30))
    assert "aliases (*name) are not read" in refused(*write(f"x0: &x0 [1]\n{pairs}"))
    assert "more than 50 levels" in refused(*write(f"x: {'[' * 1000}{']' * 1000}"))
    assert "expected 65536 bytes at most" in refused(*write("x: 1 #" + "x" * 2**16))


def test_only_the_command_line_overwrites(write, afm_rl):
    done = afm_rl(*write({"overwrite": True}), "method=physics")
    assert done.status == 2
    assert done.err == "afm-rl: overwrite=True: allowed on the command line only\n"


@pytest.mark.parametrize(
    "settings", [{"planner": {"_target_": "os.system"}}, {"cost.x": COPY}], ids=str
)
def test_a_file_calls_only_parts_of_this_library(write, afm_rl, settings):
    done = afm_rl(*write({"trust": ["os", "shutil"], **settings}), "method=physics")
    assert done.status == 2 and "only parts of afm_rl" in done.err and done.err.count("\n") == 1


def test_an_interpolated_target_is_judged_when_it_is_known(write, afm_rl, tmp_path):
    evil = write({"lead": "os.system", "cost.x._target_": "${lead}"})
    done = afm_rl(*evil, "method=physics", f"hydra.run.dir={tmp_path}/run")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("afm-rl: cost.x._target_='os.system': only parts of afm_rl")


@pytest.mark.slow
def test_so_it_is_in_a_sweep_before_a_job_begins(write, afm_rl, monkeypatch):
    monkeypatch.setattr(executor, "start", None)
    evil = write({"lead": "", "cost.x._target_": "${lead}"})
    done = afm_rl(*evil, "-m", "method=physics", f"lead={','.join(TARGETS)}")
    assert done.status == 1
    for lead in TARGETS:
        assert f"lead={lead}: failed: cost.x._target_='{lead}': only parts of afm_rl" in done.err


def test_texts_are_resolved_once(write, afm_rl, tmp_path):
    """The second time they would be targets."""
    copy = "{_target_: shutil.copyfile, src: /etc/hostname, dst: canary}"
    evil = write({"cost.x": f"\\${{oc.create:'{copy}'}}"})
    done = afm_rl(*evil, "method=physics", f"hydra.run.dir={tmp_path}/run")
    assert done.status == 2 and "unexpected keyword argument 'x'" in done.err


def test_trust_is_what_the_command_and_the_environment_said_before(monkeypatch):
    monkeypatch.setenv("AFM_RL_TRUST", "json,csv")
    with checked(["trust=[decimal]"]) as names:
        monkeypatch.setenv("AFM_RL_TRUST", "os")
        assert names == ["json", "csv", "decimal"] and trusted() == tuple(names)
    assert trusted() == ()


@pytest.mark.parametrize(
    "link",
    ["run/cli.log", "run/.hydra/x", "sweep/multirun.yaml", "sweep/0/cli.log", "sweep/0/.hydra"],
)
def test_a_link_in_the_folder_of_results_is_not_followed(refused, tmp_path, link):
    (tmp_path / link).parent.mkdir(parents=True)
    (tmp_path / link).symlink_to(tmp_path / "profile")
    place = link.partition("/")[0]
    line = refused(f"hydra.{place}.dir={tmp_path}/{place}")
    assert line.endswith(f"{link} is a link; remove it\n") and not (tmp_path / "profile").exists()
