"""A configuration calls nothing but parts of this library and what the user trusts."""

import sys
from pathlib import Path

import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.trust import check_targets, conf_folders, find_code, instantiate, trusted, trusting

DANGEROUS = """
os.system os.popen os.execv os.remove os.kill os.fork os.putenv os.open posix.system pty.spawn
subprocess.run subprocess.Popen builtins.eval builtins.exec builtins.open builtins.__import__
builtins.getattr importlib.import_module runpy.run_path code.interact pathlib.Path.write_text
shutil.rmtree shutil.copyfile tarfile.open tempfile.mktemp pickle.load pickle.Unpickler shelve.open
joblib.load torch.load torch.hub.load torch.save torch.utils.cpp_extension.load numpy.load
numpy.f2py.compile pandas.read_pickle pandas.eval sympy.sympify yaml.unsafe_load ctypes.CDLL
socket.create_connection urllib.request.urlopen requests.get asyncio.run multiprocessing.Process
threading.Thread signal.raise_signal sys.exit atexit.register logging.config.dictConfig
hydra.utils.instantiate hydra.utils.get_method
""".split()
INDIRECT = """
afm_rl.planning.costs.torch.load afm_rl.storage.artefacts.write_whole afm_rl.missions.run
afm_rl.missions.factories.load_artefact afm_rl.cli.main afm_rl.dynamics.Ensemble.load_state_dict
afm_rl.planning.MPPI.__init__ afm_rl.missions.factories afm_rl.planning.policies.save_policy
torch.optim.Optimizer.load_state_dict
afm_rl.learning.updater.os.system afm_rl_other.anything torch.optim.adam.torch.load afm_rl
hydra_plugins.anything hydra._internal.core_plugins.basic_launcher.BasicLauncher
""".split()
PLACES = (
    lambda evil: {"planner": evil},
    lambda evil: {"robot": {"regime": {"regimes": {"gain": evil}}}},
    lambda evil: {"regimes": [[{"v_gain": evil}]]},
    lambda evil: {"hydra": {"callbacks": {"x": evil}}},
)


def test_every_dangerous_target_is_refused_wherever_it_stands(tmp_path):
    canary = tmp_path / "canary"
    for target in DANGEROUS + INDIRECT:
        evil = {"_target_": target, "_args_": [f"touch {canary}"]}
        for place in PLACES:
            with pytest.raises(ConfigurationError, match="_target_='"):
                check_targets(place(evil))
        with pytest.raises(ConfigurationError, match="part.x.0._target_='"):  # when it is called
            instantiate("part", {"x": [evil]})
    assert not canary.exists()


@pytest.mark.parametrize("target", [None, 3, "", ".", ["os.system"], "afm_rl..x", {}], ids=str)
def test_what_is_no_name_is_refused(target):
    with pytest.raises(ConfigurationError, match="_target_="):
        check_targets({"planner": {"_target_": target}})


def test_trust_covers_what_a_package_defines_and_nothing_it_imports(tmp_path, monkeypatch):
    (tmp_path / "boat").mkdir()
    (tmp_path / "boat" / "__init__.py").write_text("import os\nfrom json import loads\n")
    made = "from afm_rl.dynamics import Dubins\nclass Hull: ...\nraised, model = 3, Dubins()\n"
    (tmp_path / "boat" / "hull.py").write_text(made)
    (tmp_path / "boat" / "broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    hull = {"model": {"_target_": "boat.hull.Hull"}}
    check_targets([hull, {"_target_": "boat.hull.model"}], trust=["boat"])
    for target in (
        "os.system",
        "loads",
        "hull.raised",
        "hull",
        "nothing",
        "broken.X",
        "__loader__",
    ):
        with pytest.raises(ConfigurationError, match=f"_target_='boat.{target}'"):
            check_targets({"model": {"_target_": f"boat.{target}"}}, trust=["boat"])
    for trust in ([], ["boa"], ["boats"]):
        with pytest.raises(ConfigurationError, match="trust="):
            check_targets(hull, trust)
    with trusting(["boat"]):
        check_targets(hull)
    monkeypatch.setenv("AFM_RL_TRUST", "boat")  # which is read once, before Hydra
    with pytest.raises(ConfigurationError, match="trust="):
        check_targets(hull)


def test_a_package_is_found_by_its_path_and_brings_its_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("lib/punt/conf", "raft/conf", "conf"):
        Path(name).mkdir(parents=True)
    Path("lib/punt/__init__.py").write_text("class Hull: ...")
    Path("canoe.py").write_text("class Hull: ...")
    before = sys.path[:]
    with trusting(["lib/punt", "canoe", "raft"]):  # a path, a module, a folder of settings
        places = [tmp_path / "lib/punt/conf", tmp_path / "conf", tmp_path / "raft/conf"]
        assert [path.resolve() for path in conf_folders()] == places
        assert sys.path[: len(before)] == before  # what is installed comes first
        monkeypatch.chdir("/")
        homes = [find_code("x", f"{name}.Hull").__module__ for name in ("punt", "canoe")]
        assert homes == ["punt", "canoe"]
    assert (trusted(), sys.path) == ((), before)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("dinghy", "expected a package that is installed, one in .*, or a path that ends in one"),
        ("lib/dinghy", "expected a package that is installed"),
        ("lib/torch", "another package of that name comes first, .*torch; rename yours"),
    ],
)
def test_a_package_that_is_not_there_is_named(tmp_path, monkeypatch, entry, words):
    monkeypatch.chdir(tmp_path)
    with trusting([entry]), pytest.raises(ConfigurationError, match=rf"trust=\[.*\]: .*{words}"):
        conf_folders()


def test_parts_are_made_as_hydra_makes_them(monkeypatch, tmp_path):
    (tmp_path / "raft.py").write_text("def made(*args, **parts): return args, parts")
    monkeypatch.syspath_prepend(tmp_path)
    made = {"_target_": "raft.made", "_args_": ["${x}", 2], "_convert_": "all"}
    made["deep"] = [{"_target_": "raft.made"}]
    with trusting(["raft"]):
        assert instantiate("x", made) == (("${x}", 2), {"deep": [((), {})]})
        assert instantiate("x", made | {"_recursive_": False})[1] == {"deep": made["deep"]}
        assert instantiate("x", {"y": made | {"_partial_": True}})["y"](3)[0] == ("${x}", 2, 3)
        with pytest.raises(ConfigurationError, match=r"^x.y.0: .* must be an iterable, not int"):
            instantiate("x", {"y": [made | {"_args_": 3}]})
    assert find_code("x", "os.getcwd")() == str(Path.cwd())  # a program may call what it likes
