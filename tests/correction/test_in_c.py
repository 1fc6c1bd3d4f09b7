"""The core in C says what the core in torch says."""

import subprocess
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from test_golden import drive, flow, point

from afm_rl.compiling.c_source import as_c
from afm_rl.correction.flow_options import FASTER, SIZES
from afm_rl.correction.in_c import core_in_c, sources, stored_graph
from afm_rl.errors import ConfigurationError

EQUAL = 1e-4  # shares of the largest action


def ticks_of(corrector, count):
    """Drive a point under every fault; every robot is healthy at first."""
    return drive(corrector, point(corrector.action_size), count, change=20)


def commands(corrector, count):
    return torch.stack([answer.executed for *_, answer in ticks_of(corrector, count)])


@pytest.mark.parametrize("size", SIZES)
def test_graphs_are_of_the_core_as_it_is(size):
    graph = stored_graph(size)
    assert graph is not None, "the core has changed: python -m afm_rl.correction.training.graphs"
    assert sources().encode() in graph


def one_step_apart(size, steps):
    """Compare C with torch, each step from the same memory; return what was told apart."""
    fast, model, apart = flow(size, core="c"), point(size), []
    for before, plan, box, memory, answer in ticks_of(flow(size, core="eager"), steps):
        other, said = fast.correct(before, plan, model, box)
        differ = (said.executed - answer.executed).abs().amax(-1)
        alike = differ < EQUAL
        apart.append(differ)
        assert torch.equal(said.misaligned, answer.misaligned)
        rows = alike.nonzero().squeeze(-1)
        torch.testing.assert_close(other[rows], memory[rows], rtol=2e-3, atol=2e-3)
        for one, two in zip(said, answer, strict=True):
            torch.testing.assert_close(one[rows], two[rows], rtol=1e-3, atol=1e-3)
    return torch.stack(apart)


@pytest.mark.parametrize("size", [2])
def test_a_step_is_the_same(size):
    apart = one_step_apart(size, steps=150)
    assert (apart > EQUAL).float().mean() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 6])
def test_long_drives_are_the_same_step_by_step(size):
    apart = one_step_apart(size, steps=300)
    print(size, apart.max(), (apart > EQUAL).float().mean())
    assert (apart > EQUAL).float().mean() < 1e-3


def test_a_batch_is_its_robots_one_by_one():
    fast, model = flow(2, core="c"), point(2)
    memory, plan, box, *_ = ticks_of(fast, 30)[-1]
    together = fast.correct(memory, plan, model, box)[1].executed
    for row in range(len(plan)):
        alone = fast.correct(memory[row], plan[row], model, box[row])[1].executed
        assert torch.equal(alone, together[row])
    for_all = fast.correct(memory, plan, model, box[0])[1].executed
    assert torch.equal(for_all, together)


def test_threads_do_not_share_a_workspace():
    expected = commands(flow(2, core="c"), 40)
    with ThreadPoolExecutor(10) as pool:
        found = [*pool.map(lambda _: commands(flow(2, core="c"), 40), range(10))]
    assert all(torch.equal(each, expected) for each in found)


@pytest.mark.parametrize(
    ("options", "number"), [({}, 13), ({"longest_delay": 3}, 2), ({"delay": 1}, 2)]
)
def test_what_c_cannot_do_is_said(options, number):
    with pytest.raises(ConfigurationError, match=r"corrector.core='c'.*'auto'"):
        flow(number, core="c", **options)


def test_why_there_is_no_c_is_said(monkeypatch):
    monkeypatch.setattr(core_in_c(2), "library", None)
    with pytest.raises(ConfigurationError, match="core='c': there is no graph for 2 actuators"):
        commands(flow(2, core="c"), 1)


def test_other_weights_are_not_run_in_c():
    fast, other = flow(1, core="c"), flow(1)
    assert fast.usual
    fast.load_state_dict(other.state_dict())
    assert fast.usual  # the same ones
    weights = {name: 1.1 * value for name, value in other.state_dict().items()}
    fast.load_state_dict(weights)
    assert not fast.usual


def test_torch_answers_until_c_is_there(monkeypatch):
    monkeypatch.setenv("AFM_RL_CORE", "auto")
    asked = []
    monkeypatch.setattr(core_in_c(2), "tick", lambda *given, wait: asked.append(wait))
    expected = commands(flow(2, core="eager"), 3)
    assert torch.equal(commands(flow(2), 3), expected) and asked == [False] * 3
    commands(flow(FASTER + 1), 1)
    monkeypatch.setenv("AFM_RL_CORE", "eager")
    commands(flow(2), 1)
    assert len(asked) == 3
    monkeypatch.setenv("AFM_RL_CORE", "eger")
    with pytest.raises(ConfigurationError, match="AFM_RL_CORE='eger': expected one of auto, c, e"):
        flow(2)


STRANGE = """
#include "core.c"
#include <math.h>
int main(void) {
    static const float strange[] = {NAN, INFINITY, -INFINITY, 1e30f, -1e30f, 1e-42f, 0.0f, 0.5f};
    static float memory[MEMORY], next[MEMORY], measured[3 * A + 2], plan[A], box[2 * A];
    static float command[A], predicted[A], spread[A], bounds[2 * A];
    static _Alignas(64) unsigned char workspace[1 << 22];
    bool corrects;
    unsigned state = 1;
    if (afm_core_workspace > sizeof workspace) return 2;
    for (int robot = 0; robot < 200; ++robot) {
        for (int k = 0; k < MEMORY; ++k) memory[k] = k < MEMORY - A ? 0.0f : 0.05f;
        for (int step = 0; step < 20; ++step) {
            for (int k = 0; k < 3 * A + 2; ++k) {
                state = state * 1664525u + 1013904223u;
                measured[k] = step < 10 || state >> 30 ? 0.3f * (k % 3) : strange[state >> 27 & 7];
            }
            for (int k = 0; k < A; ++k) { plan[k] = 0.4f; box[k] = -1.0f; box[A + k] = 1.0f; }
            if (robot % 4 == 3) memory[(state >> 8) % MEMORY] = strange[robot / 4 % 8];
            afm_core(1, memory, measured, plan, box, box, next, command, predicted, spread, bounds,
                     &corrects, workspace);
            for (int k = 0; k < MEMORY; ++k) memory[k] = next[k];
            for (int k = 0; k < A && robot % 4 < 3; ++k)
                if (!(command[k] >= -1.0f && command[k] <= 1.0f)) return 3;
        }
    }
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("size", [2])
def test_strange_numbers_do_no_harm(size, tmp_path):
    (tmp_path / "core.c").write_text(as_c(stored_graph(size), "afm_core"))
    (tmp_path / "main.c").write_text(STRANGE)
    sizes = [f"-DA={size}", f"-DMEMORY={sum(flow(size).learnt.sizes)}"]
    flags = ["-std=c11", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *sizes]
    run = ["gcc", *flags, "-o", str(tmp_path / "main"), str(tmp_path / "main.c"), "-lm"]
    subprocess.run(run, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
