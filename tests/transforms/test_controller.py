"""Planner and correction as one pure function, and as a file that runs without the library."""

import os
import shutil
import subprocess
import sys
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded
from torchrl.envs import Compose
from torchrl.envs.utils import step_mdp

from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.dynamics import Dubins, Ensemble, MuJoCoDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import CEM, ICEM, MPPI, GoalDistance, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy
from afm_rl.transforms.controller import Controller, Exported, check_exportable, export_controller

LOW, HIGH = torch.tensor([-1.0, -1.5]).double(), torch.tensor([1.0, 1.5]).double()
GOALS = torch.tensor([[2.0, 1.0], [-1.0, 3.0]]).double()
PROGRAM = Path(__file__).parents[2] / "examples" / "deploy" / "cpp"


def planner_of(kind=MPPI, **settings):
    world = PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH)
    settings |= {"bounds_key": ("afm", "effect_bounds")} if kind is MPPI else {}
    return kind(world, horizon=3, candidates=20, seed=5, **settings)


def policy_of(corrector=None, **limits):
    corrector = corrector or ActionFlow(LOW, HIGH)
    return ActionFlowPolicy(Dubins(), planner_of().action_spec, corrector, **limits)


def driven(act, ticks=16):
    """Return states and actions of a drive in which the motors are reversed half-way."""
    model, state, path = Dubins(), torch.zeros(3).double(), []
    for tick in range(ticks):
        goal = GOALS[tick * 2 // ticks]
        action = act(state, goal)
        path.append((state, goal, action))
        state = model(state, action * (1.0 if tick < ticks // 2 else -0.8))
    return path


def as_policy(planner, policy):
    """Return what the two do behind one another."""
    agent = TensorDictSequential(planner, policy)
    kept = Compose(*(part.make_tensordict_primer() for part in agent))(TensorDict())

    def act(state, goal):
        nonlocal kept
        kept = agent(kept.update({"observation": state, "goal": goal}))
        action, kept = kept["action"], step_mdp(kept)
        return action

    return act


def as_function(function, controller):
    """Return what a controller, or what was made of it, does."""
    memory = controller.empty()

    def act(state, goal):
        nonlocal memory
        memory, action = function(memory, state, goal, controller.draw())
        return action

    return act


def actions(path):
    return torch.stack([action for _, _, action in path])


@pytest.mark.parametrize("kind", [MPPI, ICEM])
def test_a_controller_acts_as_planner_and_policy(kind):
    expected = driven(as_policy(planner_of(kind), policy_of()))
    controller = Controller(planner_of(kind), policy_of())
    found = driven(as_function(controller, controller))
    assert torch.equal(actions(found), actions(expected))


def test_the_planner_that_is_given_stays_as_it_was():
    planner = planner_of()
    streams = planner.streams
    controller = Controller(planner, policy_of())
    assert planner.streams is streams and controller.noise_bound == 2.0


def test_parts_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="controller.planner=Linear: expected a planner"):
        Controller(torch.nn.Linear(2, 2), policy_of())
    with pytest.raises(ConfigurationError, match="controller.policy: expected a ActionFlowPolicy"):
        Controller(planner_of(), planner_of())
    controller = Controller(None, policy_of())
    for name in ("policy.txt", "nowhere/policy.onnx"):
        with pytest.raises(ConfigurationError, match=r"out=.*: expected a file NAME.onnx in a fol"):
            export_controller(controller, tmp_path / name)


def test_a_cost_that_decides_by_numbers_is_refused(tmp_path):
    cost = KnownReward(lambda s, a, n: -n.abs().sum(-1) if bool((n < 9).all()) else n[..., 0])
    planner = MPPI(PlanningEnv(Dubins(), cost, LOW, HIGH), horizon=2, candidates=4)
    controller = Controller(planner, policy_of())
    with pytest.raises(ConfigurationError, match="export: planner, Dubins or corrector decide"):
        export_controller(controller, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


ALONE = """
import sys
sys.path.insert(0, sys.argv[3])
from agent import load
agent = load(sys.argv[1], sys.argv[2])
for line in sys.stdin:
    row = [float(x) for x in line.split()]
    print(*agent.act(row[:3], row[3:], follows=True))
assert not {"afm_rl", *sys.argv[4:]} & set(sys.modules)
"""
PLAN = torch.tensor([0.4, -0.3]).double()


def lines_of(path):
    """Return what a program is given of a drive, a line a tick."""
    rows = [[*state.tolist(), *(PLAN * goal.sign()).tolist()] for state, goal, _ in path]
    return "".join(" ".join(repr(x) for x in row) + "\n" for row in rows)


def check_runs(run, path_driven, folder):
    """Check that a program of its own answers as the controller did."""
    out = subprocess.run(
        list(map(str, run)),
        input=lines_of(path_driven),
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    found = torch.tensor([[float(x) for x in line.split()] for line in out.stdout.splitlines()])
    torch.testing.assert_close(found.double(), actions(path_driven), atol=1e-5, rtol=0)


def corrected_alone(corrector, ticks=24, **limits):
    """Return the correction of a planned action as a controller, and a drive with it."""
    controller = Controller(None, policy_of(corrector, **limits))

    def towards(memory, state, goal, noise):
        return controller(memory, state, PLAN * goal.sign())

    path = driven(as_function(towards, controller), ticks)
    assert (actions(path)[-1] * PLAN < 0).any()  # it was corrected
    return controller, path


@pytest.mark.timeout(900)
@pytest.mark.slow
@pytest.mark.parametrize("flow", [False, True], ids=["LeastSquares", "ActionFlow"])
def test_a_graph_acts_the_same_without_torch(tmp_path, flow):
    """In a Python process of its own, and in the C++ program."""
    onnx = pytest.importorskip("onnx")
    corrector = None if flow else LeastSquares(LOW, HIGH)
    controller, path_driven = corrected_alone(
        corrector, max_correction=0.7, max_correction_rate=0.2
    )
    path = tmp_path / "policy.onnx"
    checksum = export_controller(controller, path)
    assert sha256(path.read_bytes()).hexdigest() == checksum and path.stat().st_size < 2e6
    run = [sys.executable, "-c", ALONE, path, checksum, PROGRAM.parent, "torch"]
    check_runs(run, path_driven, tmp_path)
    if shutil.which("c++"):
        folder = Path(find_spec("onnxruntime").origin).parent / "capi"
        for library in folder.glob("libonnxruntime.so.*"):
            build = ["c++", "-std=c++17", PROGRAM / "run_onnx.cpp", "-o", tmp_path / "run", "-ldl"]
            subprocess.run(build, check=True)
            check_runs([tmp_path / "run", library, path], path_driven, tmp_path)
    model = onnx.load(path)
    # Only one side is computed.
    assert [node.op_type for node in model.graph.node].count("If") == 1
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["arguments"].startswith("memory.mode:1 ")
    assert about["arguments"].endswith(" observation:3 action:2")
    for entry in (*model.graph.input, *model.graph.output):
        assert len(about[entry.name]) > 10


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", [MPPI, ICEM])
def test_a_graph_plans_the_same(tmp_path, kind):
    runtime = pytest.importorskip("onnxruntime")

    def make():
        return Controller(planner_of(kind), policy_of(LeastSquares(LOW, HIGH)))

    controller = make()
    export_controller(controller, tmp_path / "policy.onnx")
    session, graph = runtime.InferenceSession(tmp_path / "policy.onnx"), Exported(controller)

    def run(memory, *given):
        fields = [*(memory[name] for name in graph.names), *given]
        named = {k: x.numpy() for k, x in zip(graph.inputs, fields, strict=True)}
        *later, action = map(torch.from_numpy, session.run(None, named))
        return memory | dict(zip(graph.names, later, strict=True)), action

    expected = driven(as_function(controller, controller))
    found = driven(as_function(run, make()))
    torch.testing.assert_close(actions(found), actions(expected), atol=1e-5, rtol=0)


CART = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body></worldbody>
<actuator><motor joint="x"/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_learnt_model_is_a_graph_and_a_simulation_says_what_to_do(tmp_path):
    pytest.importorskip("onnxruntime")

    def export(model, name):
        low = -torch.ones(model.action_size)
        policy = ActionFlowPolicy(model, Bounded(low, -low), LeastSquares(low, -low))
        return export_controller(Controller(None, policy), tmp_path / name)

    network = Ensemble(Manifold(3), 2, features=[2], members=2, hidden=[8])
    assert len(export(network, "a.onnx")) == 64
    with pytest.raises(ConfigurationError, match="MuJoCoDynamics .* actuators=1 out=core"):
        export(MuJoCoDynamics(CART), "b.onnx")


def test_a_planner_of_another_kind_is_no_graph_nor_is_any_without_the_packages(
    tmp_path, monkeypatch
):
    pytest.importorskip("onnxruntime")
    with pytest.raises(ConfigurationError, match=r"policy.onnx: CEM cannot be .* MPPI or ICEM"):
        check_exportable(tmp_path / "policy.onnx", planner_of(CEM, elites=3))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigurationError, match=r"the package onnxruntime: pip install 'afm-rl"):
        check_exportable(tmp_path / "policy.onnx")
