"""What all tests share: one thread, fixed seeds, and small trained models."""

import copy
import functools
import math
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from harness import HIGH, LOW, track_of
from hypothesis import settings

import afm_rl.correction.training
import afm_rl.learning
from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins, Ensemble
from afm_rl.errors import ConfigurationError, refusing
from afm_rl.learning import pretrain_ensemble
from afm_rl.missions import factories
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain
from afm_rl.spaces.manifold import Manifold

torch.set_num_threads(1)
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("repeatable")

HERE = Path(__file__).parent
TIERS = {  # of folders and files; those that are not named here are in `make test`
    "check": (
        *("cli", "correction/test_golden.py", "diagnosis", "envs", "jobs", "missions", "play"),
        *("report", "test_deploy.py", "test_examples.py", "test_options.py", "test_paper.py"),
        *("test_published_tables.py", "test_results.py", "../notebooks/composing.ipynb"),
    ),
    "slow": (
        *("cli/test_cli_study.py", "cli/test_first_words.py", "cli/test_sweeps.py", "compiling"),
        *("contract/test_modules_on_a_gpu.py", "correction/test_disturbances.py"),
        *("missions/test_missions_on_a_gpu.py", "missions/test_random_settings.py"),
        *("suites", "test_try_page.py", "../notebooks"),
    ),
}


def pytest_collection_modifyitems(items):
    """Mark the tests of the second and third tier; of a test with cases, the second runs one."""
    tiers = {(HERE / name).resolve(): tier for tier, names in TIERS.items() for name in names}
    begun = set()
    for item in items:
        place = next((path for path in (item.path, *item.path.parents) if path in tiers), None)
        if place is not None and not item.get_closest_marker("slow"):
            test = item.nodeid.partition("[")[0]
            item.add_marker("slow" if test in begun else tiers[place])
            begun.add(test)


STATES = torch.tensor([-5.0, -5.0, -3.14]), torch.tensor([5.0, 5.0, 3.14])


@pytest.fixture(autouse=True)
def _same_for_all():
    torch.manual_seed(0)
    yield
    torch.set_num_threads(1)  # closing a parallel environment raises it


@pytest.fixture(autouse=True)
def _opened_here(monkeypatch, request):
    """Open files of others in this process, because each child takes a second to start.

    ``tests/test_hostile_files.py`` opens them in a child.
    """
    if request.path.name == "test_hostile_files.py":
        return

    def open_here(said, function, *arguments, kind=ConfigurationError, **_):
        with refusing(said, kind):
            return function(*arguments)

    for module in ("dynamics.mujoco_model", "planning.onnx_policy"):
        monkeypatch.setattr(f"afm_rl.{module}.in_child", open_here)


@pytest.fixture
def called(monkeypatch, capsys):
    """Call a command in this process; return status, output and errors."""

    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", [str(argument) for argument in arguments])
        try:
            main()
            status = 0
        except SystemExit as ended:
            status = ended.code
        said = capsys.readouterr()
        return SimpleNamespace(status=status, out=said.out, err=said.err)

    return run


@pytest.fixture
def box():
    """The action box of the ground robot."""
    return LOW, HIGH


@pytest.fixture
def states():
    """The box from which the small models were trained."""
    return STATES


@pytest.fixture
def world(box):
    """The ground robot as a planner imagines it, on its way to a goal."""
    return PlanningEnv(Dubins(), GoalDistance(), *box)


@pytest.fixture
def gains():
    """Gains on both axes of the ground robot."""
    return ActionGain(["v_gain", "omega_gain"])


@pytest.fixture
def transitions():
    """Make ``(state, action)`` of a batch shape, inside the boxes."""

    def make(*batch, seed=0, dtype=torch.float32):
        generator = torch.Generator().manual_seed(seed)
        drawn = [torch.rand(*batch, n, generator=generator, dtype=dtype) for n in (3, 2)]
        boxes = (STATES, (LOW, HIGH))
        return tuple(low + (high - low) * u for (low, high), u in zip(boxes, drawn, strict=True))

    return make


@pytest.fixture
def make_ensemble():
    """Make an untrained ensemble for the ground robot."""

    def make(**settings):
        settings = {"members": 3, "hidden": [16, 16], **settings}
        model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], **settings)
        model.input_mean.copy_(torch.tensor([0.1, 0.0, -0.2, 0.3]))
        model.input_std.copy_(torch.tensor([1.5, 0.7, 0.5, 0.8]))
        model.target_mean.copy_(torch.tensor([0.01, -0.02, 0.03]))
        model.target_std.copy_(torch.tensor([0.1, 0.2, 0.3]))
        return model

    return make


@pytest.fixture(scope="session")
def _trained_ensemble():
    model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], members=3, hidden=[48, 48])
    settings = {"samples": 16_000, "epochs": 20, "lr": 1e-2}
    report = pretrain_ensemble(model, Dubins(), STATES, (LOW, HIGH), **settings)
    return model, report.error


@pytest.fixture
def trained_ensemble(_trained_ensemble):
    """A small ensemble that has learnt the nominal ground robot; a copy for each test."""
    return copy.deepcopy(_trained_ensemble[0])


@pytest.fixture
def trained_error(_trained_ensemble):
    """Its held-out error."""
    return _trained_ensemble[1]


@pytest.fixture
def flow():
    """The action flow of the ground robot."""
    return ActionFlow(LOW, HIGH)


@pytest.fixture
def short_trainings(monkeypatch):
    """Cut every training short."""
    flow, ensemble = {"iterations": 5}, {"samples": 512, "epochs": 1}
    for module, name, small in (
        (afm_rl.correction.training, "train_flow", flow),
        (afm_rl.learning, "pretrain_ensemble", ensemble),
        (factories, "train_flow", flow),
        (factories, "pretrain_ensemble", ensemble),
    ):
        whole = getattr(module, name)

        def short(*args, _whole=whole, _small=small, **settings):
            return _whole(*args, **{**settings, **_small, "progress": False})

        monkeypatch.setattr(module, name, functools.wraps(whole)(short))


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of trained parts that all tests share."""
    return tmp_path_factory.getbasetemp() / "trained_parts"


@pytest.fixture
def chromium():
    """A headless browser."""
    playwright = pytest.importorskip("playwright.sync_api")
    names = "chromium", "chromium-browser", "chrome"
    if (path := next(filter(None, map(shutil.which, names)), None)) is None:
        pytest.skip("no Chromium on this machine")
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
    flags += ["--enable-unsafe-swiftshader", "--disable-background-networking"]
    flags += ["--disable-component-update", "--disable-sync", "--no-first-run"]
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=path, args=flags)
        yield browser
        browser.close()


@pytest.fixture
def ring(tmp_path_factory):
    """A round track of 20 targets, 1 m apart."""
    angles = [2 * math.pi * k / 19 for k in range(19)]
    points = [(3.02 * math.cos(a), 3.02 * math.sin(a)) for a in angles]
    return track_of(tmp_path_factory.mktemp("tracks") / "ring.csv", points)
