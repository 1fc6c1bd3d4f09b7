"""A host's model is asked for what shows the effective action; and programs that do so."""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from afm_rl import ActionFlowWrapper, FaultWrapper
from afm_rl.correction import ActionFlow
from afm_rl.correction.training.measuring import MeasureGraph
from afm_rl.dynamics import KnownDynamics, effective_action
from afm_rl.planning import load_policy
from afm_rl.spaces.manifold import Manifold

EXAMPLES = Path(__file__).parents[2] / "examples"
A, D, STD = 2, 3, 0.05


@pytest.fixture(scope="module")
def flow():
    return ActionFlow(-torch.ones(A), torch.ones(A))


@pytest.fixture(scope="module")
def bent():
    """A model that is far from linear in its action."""
    mixed = torch.randn(D, A, generator=torch.Generator().manual_seed(0)).double()
    step = lambda state, action: state + torch.tanh(3 * action @ mixed.mT)  # noqa: E731
    model = KnownDynamics(step, Manifold(D), A, noise_std=STD)
    model.stiff = True  # so that rounds are in double precision
    return model


def asked(flow, model, memory, state, sent, reached):
    """Return what a host finds that answers until nothing is wanted, and how often it answered."""
    graph = MeasureGraph(flow, D)
    search = torch.zeros(sum(graph.layout.sizes)).double()
    error, jacobian = (reached - model(state, sent)) / STD, torch.full((D, A), torch.nan).double()
    for answers in range(1, 20):
        search, where, wants, measured = graph(memory, search, sent, error, jacobian)
        if wants == 0:
            assert not search.any()  # ready for the next transition
            return measured, answers
        if wants == 1:
            error = (reached - model(state, where)) / STD
        else:
            jacobian = model.jacobian(state, where) / STD
    raise AssertionError("it asks for ever")


def test_what_is_asked_for_shows_the_effective_action(flow, bent):
    draws, answers = torch.Generator().manual_seed(1), []
    for row in range(60):
        state, sent, true, foreseen, noise = (
            torch.rand(size, generator=draws).double() * 2 - 1 for size in (D, A, A, A, D)
        )
        true = sent if row % 4 == 0 else true
        reached = bent(state, true) + 0.2 * STD * noise
        reached[0] = torch.nan if row == 7 else reached[0]
        fields = flow.learnt.unpack(flow.core_of(flow.begin(state.float())))
        memory = flow.learnt.pack({**fields, "acting": foreseen.float()})
        found = effective_action(
            bent, state, sent, reached, torch.ones(A), quiet=flow.quiet, guess=foreseen
        )
        measured, count = asked(flow, bent, memory, state, sent, reached)
        answers.append(count)
        finite = torch.tensor([float(row != 7)])
        parts = [sent, found.action, found.std, finite, found.innovation[None]]
        torch.testing.assert_close(measured, torch.cat(parts).float(), rtol=1e-4, atol=1e-5)
    assert min(answers) == 1  # nothing to be explained
    assert max(answers) > 5


def run(*words):
    return subprocess.run([*map(str, words)], capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_program_in_c_does_what_the_wrapper_does(tmp_path):
    """Of MuJoCo and C alone; the motor of a thigh is reversed after a fifth of 1,000 steps."""
    for package in ("emx_onnx_cgen", "onnxruntime"):
        pytest.importorskip(package)
    if not shutil.which("cc"):
        pytest.skip("no C compiler")
    run(sys.executable, EXAMPLES / "deploy" / "c" / "build.py", tmp_path)
    assets = Path(find_spec("gymnasium").origin).parent / "envs" / "mujoco" / "assets"
    program = [tmp_path / "half_cheetah", assets / "half_cheetah.xml"]
    alone, afm = ([*map(float, run(*program, way).split())] for way in ("alone", "afm"))
    assert alone[0] == afm[0]  # while it is healthy, to the bit
    policy, _ = load_policy(EXAMPLES / "policies" / "zoo" / "half_cheetah_sac.safetensors")
    robot = FaultWrapper(
        gymnasium.make("HalfCheetah-v5", reset_noise_scale=0.0), {"gain_3": -1.0}, at=200
    )
    env = ActionFlowWrapper(robot)
    observation, _ = env.reset(seed=0)
    for _ in range(1000):
        action = policy(torch.as_tensor(observation, dtype=torch.float32)).numpy()
        observation, *_ = env.step(action)
    whole = float(robot.unwrapped.data.qpos[0])
    assert afm[1] == pytest.approx(whole, rel=0.05)  # of a gait that is chaotic
    assert alone[1] < 0.5 * whole


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_numpy_alone_runs_the_core(tmp_path):
    pytest.importorskip("emx_onnx_cgen")
    if not shutil.which("cc"):
        pytest.skip("no C compiler")
    export = ["-m", "afm_rl.cli.export", "actuators=2", f"out={tmp_path / 'core.c'}"]
    run(sys.executable, *export)
    library = tmp_path / "core.so"
    run("cc", "-O1", "-shared", "-fPIC", "-o", library, tmp_path / "core.c", "-lm")
    program = EXAMPLES / "deploy" / "c" / "numpy_alone.py"
    lines = run(sys.executable, program, library, tmp_path / "core.h").splitlines()
    assert len(lines) == 60
    corrected = [line.endswith("corrected") for line in lines]
    assert not any(corrected[:20])  # healthy
    assert all(corrected[25:])
    planned, moved = (
        np.array([line.split("[")[k].split("]")[0].split() for line in lines], float)
        for k in (1, 2)
    )
    np.testing.assert_allclose(moved[25:], planned[25:], atol=0.01)
    np.testing.assert_allclose(moved[20], planned[20] * [-1, 1], atol=1e-6)
