"""Settings from a file run no code, however they are written; what they may set does its work."""

import os
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from afm_rl.cli.overrides import checked
from afm_rl.errors import ConfigurationError
from afm_rl.jobs import executor
from afm_rl.trust import trusted

TARGETS = """
os.system shutil.copyfile logging.FileHandler pandas.eval numpy.savetxt multiprocessing.Process
""".split()
COPY = {"_target_": "${lead}", "src": "/etc/hostname", "dst": "canary"}
SAVED = {"_target_": "afm_rl.planning.policies.save_policy", "file": "canary"}
LOG = "hydra.job_logging.handlers.file"
FILE = {
    f"{LOG}.class": "logging.FileHandler",
    f"{LOG}.filename": "${hydra.runtime.output_dir}/a.log",
}
ALONE = "the command line only"
ATTACKS = [
    *(
        ({"hydra.job.env_set": {name: "x"}}, f"hydra.job.env_set.{name}='x': a file may not")
        for name in ("AFM_RL_TRUST", "LD_PRELOAD", "PYTHONPATH", "PATH", "RAY_ADDRESS", "HOME")
    ),
    ({"hydra.job.env_set.OMP_NUM_THREADS": "1\nx"}, ALONE),
    ({"hydra.job.env_set": "${x}", "x": {"LD_PRELOAD": "x"}}, "env_set.LD_PRELOAD='x'"),
    ({"hydra.job.env_copy": ["PATH"]}, "hydra.job.env_set.PATH"),
    ({"hydra.job.chdir": True}, ALONE),
    ({"hydra.job.name": "../../x"}, ALONE),
    ({"hydra.output_subdir": "../.."}, ALONE),
    ({"hydra.output_subdir": "x"}, ALONE),
    ({"hydra.overrides.task": ["trust=[os]"]}, "hydra.overrides: a file may not"),
    ({"hydra.overrides.hydra": ["hydra.launcher.address=x"]}, "hydra.overrides: a file may not"),
    ({"overwrite": True}, ALONE),
    # What Hydra calls itself.
    ({"lead": "shutil.copyfile", "hydra.callbacks": {"x": COPY}}, "callbacks.x._target_='shutil"),
    ({"lead": "shutil.copyfile", "x": {"y": COPY}, "hydra.callbacks": "${x}"}, "callbacks.y._t"),
    ({"hydra.callbacks.x": "${oc.create:'{_target_: os.system}'}"}, "callbacks.x._target_='os.s"),
    ({"hydra.callbacks.x": "\\${lead}"}, "hydra.callbacks.x='${lead}': expected a value"),
    ({"hydra.callbacks.x": SAVED}, "is code of afm_rl.planning.policies"),
    ({"hydra.launcher.n_jobs": "${x}", "x": COPY, "lead": "os.system"}, "_target_='os.system'"),
    ({"hydra.sweeper.params": {"x": SAVED}}, "is code of afm_rl.planning.policies"),
    ({"hydra.launcher": {"address": "x"}}, ALONE),
    ({"hydra.launcher._target_": "hydra_plugins.hydra_joblib_launcher.X"}, "trust=[PACKAGE]"),
    ({"hydra.sweeper._target_": "hydra_plugins.hydra_optuna_sweeper.X"}, "trust=[PACKAGE]"),
    ({"hydra.launcher.address": "evil.example:6379"}, "hydra.launcher.address='evil.example:6379'"),
    ({"hydra.launcher.parameters.slurm_setup": ["touch canary"]}, "slurm_setup.0='touch canary'"),
    ({"hydra.launcher.parameters.slurm_srun_args": ["--x"]}, ALONE),
    ({"hydra.launcher.parameters.slurm_additional_parameters.x": "x"}, ALONE),
    ({"hydra.launcher.parameters": "${x}", "x": {"slurm_setup": ["x"]}}, "slurm_setup.0='x'"),
    ({"hydra.launcher.parameters.slurm_qos": "x\ntouch canary #"}, ALONE),
    # What is logged, and where.
    ({**FILE, f"{LOG}.filename": "/tmp/.profile"}, f"{LOG}.filename='/tmp/.profile'"),
    ({**FILE, f"{LOG}.filename": "${hydra.runtime.output_dir}/.profile"}, ALONE),
    ({**FILE, f"{LOG}.filename": "${hydra.runtime.output_dir}/../x.log"}, ALONE),
    ({**FILE, f"{LOG}.class": "logging.handlers.SocketHandler"}, ALONE),
    ({**FILE, f"{LOG}.()": "os.system"}, ALONE),
    ({**FILE, f"{LOG}.level": "ext://antigravity.x"}, ALONE),
    ({"hydra.job_logging.formatters.simple.format": "rm -r ~ # %(message)s"}, ALONE),
    ({"hydra.job_logging.handlers": {"x\n": {"class": "logging.FileHandler"}}}, ALONE),
    ({"hydra.job_logging.formatters.simple.class": "os.system"}, ALONE),
    ({"hydra.job_logging.handlers": "${x}", "x": {"y": {"class": "os.system"}}}, ALONE),
    ({"hydra.hydra_logging.handlers.x.class": "logging.FileHandler"}, ALONE),
    # Where Hydra looks for files: it imports the package.
    ({"hydra.searchpath": ["pkg://afm_rl.conf", "pkg://stranger"]}, "hydra.searchpath='stranger'"),
    ({"hydra.searchpath": ["pkg://afm_rl.conf", "pkg:///stranger/"]}, "hydra.searchpath="),
    *(
        ({"cost.x._target_": target}, f"cost.x._target_='{target}': only parts")
        for target in TARGETS
    ),
    ({"label": {"_target_": "os.system"}}, "label._target_='os.system': only parts"),
    ({"trust": ["os"], "planner": {"_target_": "os.system"}}, "planner._target_='os.system'"),
]


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write a file of settings by places, and work in an empty folder from which modules come."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "__init__.py").write_text("open('canary', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)

    def make(settings, base=("config", "_self_")):
        places = {"hydra.searchpath": ["pkg://afm_rl.conf"], **settings}
        cfg = OmegaConf.create({"defaults": list(base)})
        for place, value in places.items():
            OmegaConf.update(cfg, place, value, force_add=True)
        (tmp_path / "conf" / "evil.yaml").write_text(OmegaConf.to_yaml(cfg))
        return ["--config-path", tmp_path / "conf", "--config-name", "evil"]

    yield make
    assert not Path("canary").exists() and "stranger" not in sys.modules


@pytest.fixture
def composed(write, tmp_path):
    """Compose a file of settings as the command line does, without most of what it leads to."""
    base = [{"launcher": "local"}, {"override hydra/launcher": None}, "_self_"]

    def make(settings, *arguments):
        write({"overwrite": False, **settings}, base)
        folder = str(tmp_path / "conf")
        with checked(arguments), initialize_config_dir(folder, version_base="1.3"):
            return compose("evil", list(arguments), return_hydra_config=True)

    return make


@pytest.mark.parametrize(("settings", "words"), ATTACKS, ids=str)
def test_what_a_file_may_not_set(composed, settings, words):
    with pytest.raises(ConfigurationError) as error:
        composed(settings)
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("lead", TARGETS)
def test_an_interpolated_target_is_judged_when_it_is_known(write, afm_rl, tmp_path, lead):
    evil = write({"lead": lead, "cost.x._target_": "${lead}"})
    done = afm_rl(*evil, "method=physics", f"hydra.run.dir={tmp_path}/run")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"afm-rl: cost.x._target_='{lead}': only parts of afm_rl")


def test_so_it_is_in_a_sweep_before_a_job_begins(write, afm_rl, monkeypatch):
    monkeypatch.setattr(executor, "start", None)
    evil = write({"lead": "", "cost.x._target_": "${lead}"})
    done = afm_rl(*evil, "-m", "method=physics", f"lead={','.join(TARGETS)}")
    assert done.status == 1
    for lead in TARGETS:
        assert f"lead={lead}: failed: cost.x._target_='{lead}': only parts of afm_rl" in done.err
    done = afm_rl(*write({"cost.x._target_": "os.system"}), "-m", "method=physics", "seeds=1,2")
    assert done.status == 2 and "cost.x._target_='os.system'" in done.err


def test_texts_are_resolved_once(write, afm_rl, tmp_path):
    """The second time they would be targets."""
    copy = "{_target_: shutil.copyfile, src: /etc/hostname, dst: canary}"
    evil = write({"cost.x": f"\\${{oc.create:'{copy}'}}"})
    done = afm_rl(*evil, "method=physics", f"hydra.run.dir={tmp_path}/run")
    assert done.status == 2 and "unexpected keyword argument 'x'" in done.err


def test_what_is_set_on_the_command_line_counts(composed):
    given = [
        *("overwrite=true", "hydra.launcher.address=head:6379", "+hydra.job.env_set.LD_PRELOAD=x"),
        "+hydra.launcher.parameters={slurm_setup: [module load x], mem_gb: 2}",
    ]
    evil = {"hydra.launcher.parameters.slurm_setup": ["touch canary"]}
    cfg = composed(evil, "launcher=ray", *given)
    assert cfg.hydra.launcher.parameters == {"slurm_setup": ["module load x"], "mem_gb": 2}
    with pytest.raises(ConfigurationError, match=r"slurm_setup.0='touch canary': a file may not"):
        composed(evil, "launcher=ray", "+hydra.launcher.parameters.mem_gb=2")


def test_trust_is_what_the_command_and_the_environment_said_before(monkeypatch):
    monkeypatch.setenv("AFM_RL_TRUST", "json,csv")
    with checked(["trust=[decimal]"]) as names:
        monkeypatch.setenv("AFM_RL_TRUST", "os")
        assert names == ["json", "csv", "decimal"] and trusted() == tuple(names)
    assert trusted() == ()


def test_a_link_in_the_folder_of_results_is_not_followed(composed, tmp_path):
    links = {"run": ["cli.log", ".hydra/x"], "sweep": ["multirun.yaml", "0/cli.log", "0/.hydra"]}
    for place, name in ((place, name) for place, names in links.items() for name in names):
        folder = tmp_path / place / name.replace("/", "-")
        (folder / name).parent.mkdir(parents=True)
        (folder / name).symlink_to(tmp_path / "profile")
        with pytest.raises(ConfigurationError, match=f"{name} is a link; remove it"):
            composed({f"hydra.{place}.dir": str(folder)})


def test_what_a_file_may_set_of_hydra_does_its_work(write, afm_rl, tmp_path, quick, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    seen = []
    start = executor.LocalExecutor.start
    monkeypatch.setattr(
        executor.LocalExecutor,
        "start",
        lambda self, jobs: [seen.append(os.environ["CUDA_VISIBLE_DEVICES"]), *start(self, jobs)][
            1:
        ],
    )
    harmless = {
        **{"hydra.job.env_set.CUDA_VISIBLE_DEVICES": "1", "cores": 1, "hydra.verbose": "none"},
        **{"hydra.launcher.n_jobs": "${cores}", "hydra.run.dir": str(tmp_path / "run"), **FILE},
        "hydra.job_logging.root.handlers": ["console", "file"],
        "hydra.job_logging.formatters.simple.format": "[%(asctime)s] %(levelname)-8s | %(message)s",
        f"{LOG}.formatter": "simple",
    }
    own = write(harmless)
    done = afm_rl(*own, "method=physics", "budget=2", *quick)
    assert (done.status, done.err) == (0, "") and (tmp_path / "run" / "a.log").is_file()
    done = afm_rl(*own, "-m", "method=physics", "budget=2", "seeds=1,2", *quick)
    assert (done.status, done.err) == (0, "") and seen == ["1", "1"]
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "0"
    (jobs,) = tmp_path.glob("multirun/*/jobs.yaml")
    assert len(yaml.safe_load(jobs.read_text())["jobs"]) == 2
