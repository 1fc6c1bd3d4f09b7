"""The tick as machine code."""

import os

import pytest
import torch

from afm_rl.compiling import machine_code
from afm_rl.correction import ActionFlow
from afm_rl.correction.context_windows import CONTEXT_WINDOWS
from afm_rl.correction.network import AxisNetwork


def flow_of(cache, **settings):
    network = AxisNetwork(width=8, latent=8)
    # Among samples or readings that are as good, rounding would decide.
    distinct = [name for name in CONTEXT_WINDOWS if name not in ("long", "nearest")]
    settings |= {"source_std": 0.0, "hypotheses": distinct, "place": [0]}
    flow = ActionFlow(-torch.ones(1), torch.ones(1), network=network, cache=cache, **settings)
    return flow.double()


def reversed_drive(sent):
    return -sent[-1]


@pytest.mark.slow
@pytest.mark.filterwarnings("error:compile=true")
def test_what_is_compiled_says_the_same_for_any_number_of_missions(
    line, drive, plans, tmp_path, traced
):
    code = flow_of(tmp_path, compile=True)
    for batch in [(), (3,), (2, 2)]:
        planned = plans(12, *batch, 1, size=1.0).double()
        expected, _ = drive(flow_of(tmp_path), line(1), reversed_drive, planned)
        found, _ = drive(code, line(1), reversed_drive, planned)
        assert expected[5][4:].double().mean() > 0.5  # mostly it corrects
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    assert len(set(traced)) == 3  # observe, look, decide


def test_without_a_compiler_the_tick_runs_as_it_is(line, drive, plans, tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "has_compiler", lambda: False)
    planned = plans(4, 1).double()
    with pytest.warns(UserWarning, match="compile=true: goes on uncompiled: no C.. compiler"):
        found, _ = drive(flow_of(tmp_path, compile=True), line(1), reversed_drive, planned)
    expected, _ = drive(flow_of(tmp_path), line(1), reversed_drive, planned)
    assert torch.equal(found[0], expected[0])


def test_a_model_that_learns_is_no_part_of_machine_code(line, plans, tmp_path):
    flow, model, run = flow_of(tmp_path, compile=True), line(1), []

    def as_it_is(function, *arguments, **parts):
        run.append(function.__name__)
        return function(flow, *arguments, **parts)

    flow.__dict__["_machine_code"] = as_it_is
    memory, plan = flow.begin(torch.zeros(1).double()), plans(1).double()
    for model.taught_in in (None, os.getpid()):
        flow.correct(memory, plan, model, torch.tensor([[-1.0], [1.0]]).double())
    assert run == ["detect"]
