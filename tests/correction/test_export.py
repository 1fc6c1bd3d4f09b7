"""The tick and the search for the effective action as graphs: they say what torch says."""

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

from afm_rl.correction import ActionFlow
from afm_rl.correction.export import SearchGraph, fields_of, search_graph, tick_graph
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy" / "core_alone.py"
ALONE = """
import runpy, sys
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
assert not {"afm_rl", "torch"} & set(sys.modules)
"""
RECORDS = "memory", "measurement", "plan"
SIZES = [1, 2, 6, 12, 29]


def flow_of(size, dtype=torch.float64, **settings):
    one = torch.ones(size, dtype=dtype)
    flow = ActionFlow(-one, one, **settings)
    flow.core.to(dtype)
    return flow


def ticks_of(flow, steps=120):
    """Return what ticks of a closed loop were given, and what they returned.

    A point has other gains after a quarter of the steps, an offset in addition after half, and
    late commands at the end; now and then there is no reading.
    """
    size, dtype, core, ticks = flow.action_size, flow.scale.dtype, flow.core, []
    draws, tick = torch.Generator().manual_seed(0), core.tick

    def recorded(memory, measured, plan):
        answer = tick(memory, measured, plan)
        if measured.hidden is None:  # a graph has no input that may be absent
            measured = measured._replace(hidden=torch.zeros_like(memory.hidden))
        ticks.append(((memory, measured, plan), answer))
        return answer

    core.tick = recorded
    model = KnownDynamics(lambda s, a: s + 0.1 * a, Manifold(size), size, noise_std=0.01)
    gains = torch.linspace(-0.8, 1.2, size, dtype=dtype)
    box = torch.stack([flow.lowest, flow.highest])
    state, sent = torch.zeros(size, dtype=dtype), []
    memory = flow.begin(state)
    for step in range(steps):
        plan = 1.8 * torch.rand(size, generator=draws).to(dtype) - 0.9
        memory, answer = flow.correct(memory, plan, model, box)
        sent.append(answer.executed_action)
        acting = sent[-1 if step < 0.6 * steps else -3]
        effect = acting if step < steps / 4 else gains * acting + 0.1 * (step > steps / 2)
        state = model(state, effect) + 5e-4 * torch.randn(size, generator=draws).to(dtype)
        memory = flow.observe(
            memory, torch.full_like(state, torch.nan) if step % 37 == 20 else state
        )
    del core.tick
    return ticks


def session_of(graph, *given):
    """Write a graph, and open it."""
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    return runtime.InferenceSession(graph(*given), providers=["CPUExecutionProvider"])


def given_to(records):
    """Return the inputs of a graph of the tick."""
    pairs = zip(RECORDS, records, strict=True)
    return {k: x for name, record in pairs for k, x in fields_of(name, record).items()}


def run(session, inputs):
    names = [output.name for output in session.get_outputs()]
    found = session.run(names, {name: x.numpy() for name, x in inputs.items()})
    return dict(zip(names, map(torch.from_numpy, found), strict=True))


def check_ticks(session, ticks, tolerance):
    """Check that one tick from the same memory says the same, of every tick of a closed loop."""
    corrected = 0
    for records, (memory, step) in ticks:
        expected = {**fields_of("next_memory", memory), **fields_of("step", step)}
        found = run(session, given_to(records))
        assert list(found) == list(expected)
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, atol=tolerance, rtol=0, msg=name)
        corrected += int(step.corrected)
    assert 20 < corrected < len(ticks)


@cache
def tick_of(size):
    """Return the graph of a tick in double precision, written once."""
    return tick_graph(flow_of(size).core)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.timeout(900)
def test_a_tick_is_the_same(size):
    check_ticks(session_of(tick_of, size), ticks_of(flow_of(size)), 1e-5)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_tick_with_a_known_delay_and_context_coordinates_is_the_same():
    flow = flow_of(2, delay=2, context_coordinates=[0])
    session = session_of(tick_graph, flow.core)
    assert {"plan.queue", "plan.context", "memory.contexts"} <= {
        entry.name for entry in session.get_inputs()
    }
    check_ticks(session, ticks_of(flow), 1e-5)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_in_single_precision_a_graph_is_as_exact_as_torch():
    """The fit of lag and gain is nearly singular: both differ from double precision."""
    flow, exact = flow_of(6, torch.float32), flow_of(6).core
    ticks, session = ticks_of(flow), session_of(tick_graph, flow.core)
    errors = {"next_memory.forecasts": [], "step.command": []}
    for records, (memory, step) in ticks:
        doubled = (type(of)._make(x if x is None else x.double() for x in of) for of in records)
        found, (exact_memory, exact_step) = run(session, given_to(records)), exact.tick(*doubled)
        for name, of_torch, of_double in (
            ("next_memory.forecasts", memory.forecasts, exact_memory.forecasts),
            ("step.command", step.command, exact_step.command),
        ):
            errors[name].append([(x - of_double).abs().max() for x in (found[name], of_torch)])
    for name, limit in (("next_memory.forecasts", 0.05), ("step.command", 0.02)):
        graph, in_torch = torch.tensor(errors[name]).T
        assert graph.max() < max(3 * in_torch.max(), 1e-5)
        assert graph.quantile(0.95) < limit  # a choice between two that are alike may differ


def numbers(line, word):
    """Return the two numbers in brackets after a word."""
    return [float(x) for x in re.search(rf"{word} \[(.*?)\]", line)[1].split()]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_core_runs_with_onnxruntime_and_numpy_alone(tmp_path):
    pytest.importorskip("onnxscript")
    (tmp_path / "core.onnx").write_bytes(tick_of(2))
    words = [sys.executable, "-c", ALONE, EXAMPLE, tmp_path / "core.onnx"]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 60
    assert not any("corrected" in line for line in lines[:21])
    assert sum("corrected" in line for line in lines[21:]) > 20
    planned, moved = (numbers(lines[-1], word) for word in ("planned", "moved"))
    assert moved == pytest.approx(planned, abs=0.1)


def bent(coordinates, size, rank, slope=3.0):
    """Return a model that is far from linear in its action, and sees as many numbers of it.

    Of redundant actuators rounding grows from round to round: a small slope needs few.
    """
    draws = torch.Generator().manual_seed(0)
    rows, columns = (torch.randn(k, rank, generator=draws).double() for k in (coordinates, size))
    mixed = rows @ columns.mT / rank**0.5
    model = KnownDynamics(
        lambda state, action: state + torch.tanh(slope * action @ mixed.mT / size**0.5),
        Manifold(coordinates),
        size,
        noise_std=0.05,
    )
    model.stiff = True  # so that rounds are in double precision
    return model


def answered(ask, inputs, memory, model, state, sent, reached):
    """Return what a host finds that answers until nothing is wanted, and how often it answered."""
    _, std = model.forecast(state, sent)
    given = {name: torch.zeros_like(x) for name, x in inputs.items()}
    given |= {name: memory[name] for name in given if name in memory}
    given |= {"sent": sent, "error": (reached - model(state, sent)) / std}
    given["jacobian"] = torch.full_like(given["jacobian"], torch.nan)  # not wanted yet
    for answers in range(1, 20):
        found = ask(given)
        given |= {k.removeprefix("next_"): x for k, x in found.items() if k.startswith("next_")}
        where, wants = found["asked"], int(found["wants"])
        if wants == 0:
            assert not any(x.any() for k, x in found.items() if k.startswith("next_"))
            return found, answers
        if wants == 1:
            given["error"] = (reached - model(state, where)) / std
        else:
            given["jacobian"] = model.jacobian(state, where) / std[:, None]
    raise AssertionError("it asks without end")


def check_search(flow, model, ask, inputs, rows):
    """Check that answers to its questions lead to the measurement of the corrector."""
    size, coordinates, draws = flow.action_size, model.state_size, torch.Generator().manual_seed(1)
    answers = []
    for row in range(rows):
        state, sent, true, foreseen, noise = (
            2 * torch.rand(k, generator=draws).double() - 1
            for k in (coordinates, size, size, size, coordinates)
        )
        reached = model(state, sent if row % 4 == 0 else true) + 0.01 * noise
        reached[0] = torch.nan if row == 7 else reached[0]
        fields = flow.begin(state)
        newest = {"states": state, "actions": sent, "next_states": reached}
        for name, value in newest.items():
            fields[name][-1] = value
        fields["valid"][-1] = float(row != 7)
        fields["expected"][:] = foreseen
        fields["corrected"] += row % 3 == 0
        fields["usual"] += 0.1 * (row % 5)
        fields["hidden"] += 0.1 * (row % 6 == 3)
        expected = fields_of("measurement", flow.measure(fields, model)[0])
        memory = fields_of("memory", flow.core_of(fields))
        found, count = answered(ask, inputs, memory, model, state, sent, reached)
        answers.append(count)
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, atol=1e-5, rtol=0, msg=name)
    assert min(answers) == 1  # nothing to be explained
    assert max(answers) >= 5


@pytest.mark.parametrize(("size", "rank", "slope"), [(2, 2, 3.0), (4, 2, 0.3)])
def test_a_host_that_answers_finds_the_measurement(size, rank, slope):
    """Also of redundant actuators, of which a model sees a part."""
    flow, coordinates = flow_of(size), 3
    graph = SearchGraph(flow.core, coordinates)

    def ask(given):
        return dict(zip(graph.outputs, graph(*given.values()), strict=True))

    check_search(flow, bent(coordinates, size, rank, slope), ask, graph.inputs, rows=12)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.timeout(900)
def test_a_search_is_the_same(size):
    flow, coordinates = flow_of(size), size + 2
    inputs = SearchGraph(flow.core, coordinates).inputs
    session = session_of(search_graph, flow.core, coordinates)
    model = bent(coordinates, size, min(size, coordinates))
    check_search(flow, model, lambda given: run(session, given), inputs, rows=20)


@pytest.mark.slow
def test_a_tick_compiles_without_a_break():
    flow = flow_of(1)
    compiled = torch.compile(flow.core.tick, backend="eager", fullgraph=True)
    records, expected = ticks_of(flow, steps=40)[-1]
    assert expected[1].corrected
    for found, record in zip(compiled(*records), expected, strict=True):
        for name, value in record._asdict().items():
            torch.testing.assert_close(getattr(found, name), value, msg=name)
