"""Planned, executed and effective actions as a log that a diagnosis reads as it is."""

import multiprocessing
import os
import resource
import signal
import warnings
from copy import deepcopy

import numpy as np
import pandas as pd
import pytest
import torch
from shells import SHELLS, by_tier, controller, plans_of, policy

from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import read_log
from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.transforms.record import Recorder

STEPS = 40
OLD = {"planned_action": "planned", "executed_action": "command", "effective_action": "effective"}
GAINS = torch.tensor([-0.5, 1.0])  # of the puck


def record(shell, file):
    """Record two episodes; a policy hears of none, but of the steps of its environment."""
    ends = STEPS if shell is policy else STEPS // 2
    list(shell(plans_of(STEPS), torch.float32, gain=GAINS, ends=ends, record=file))


@pytest.mark.parametrize("name", by_tier(sorted(SHELLS.keys() - {"controller"})))
def test_what_is_recorded_is_a_log(tmp_path, name):
    record(SHELLS[name], tmp_path / "drive" / "log.csv")
    table = pd.read_csv(tmp_path / "drive" / "log.csv")
    kinds = ("planned_action", "executed_action", "effective_action")
    names = [f"{kind}.{k}" for kind in kinds for k in range(2)]
    assert list(table)[-10:] == [*names, *(f"state.{k}" for k in range(4))]
    assert len(table) >= STEPS - 2 and not table.isna().any().any()
    log = read_log(tmp_path / "drive" / "log.csv")
    assert log.computed
    assert log.begins.sum() == {"policy": 1, "transform": 2, "wrapper": 2}.get(name, 4)
    np.testing.assert_allclose(log.response, log.command * GAINS.numpy(), atol=1e-3)
    old = {f"{new}.{k}": f"{old}.{k}" for new, old in OLD.items() for k in range(2)}
    table.rename(columns=old).to_csv(tmp_path / "old.csv", index=False)  # of 0.3.0
    np.testing.assert_array_equal(read_log(tmp_path / "old.csv").response, log.response)
    assert not np.allclose(
        table["planned_action.0"], table["executed_action.0"]
    )  # it was corrected
    assert str(diagnose(log)).splitlines() == ["0: reversed, 50 % of the command", "1: healthy"]


def drive_and_die(file):
    record(policy, file)
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_file_is_whole_after_a_kill(tmp_path):
    process = multiprocessing.get_context("fork").Process(
        target=drive_and_die, args=(tmp_path / "log.csv",)
    )
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert len(read_log(tmp_path / "log.csv").command) == STEPS - 1  # the last has no effect yet
    assert (tmp_path / "log.csv").read_bytes().endswith(b"\n")


def in_a_process(work, *given):
    """Return what a copy of this process says of a failure, empty if it has none."""

    def tell(queue):
        try:
            work(*given)
        except ConfigurationError as error:
            queue.put(str(error))
        else:
            queue.put("")

    queue = (forked := multiprocessing.get_context("fork")).Queue()
    process = forked.Process(target=tell, args=(queue,))
    process.start()
    said = queue.get(timeout=60)
    process.join(60)
    return said


def test_a_copy_of_the_process_does_not_mix_in_its_lines(tmp_path):
    drive = policy(plans_of(40), torch.float32, ends=40, record=tmp_path / "log.csv")
    for _ in range(5):
        next(drive)
    assert "expected a file for each process" in in_a_process(next, drive)
    list(drive)
    assert len(read_log(tmp_path / "log.csv").command) == 39


def test_where_the_disk_is_full_no_line_is_cut(tmp_path):
    file = tmp_path / "log.csv"

    def fill():
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            record(policy, file)
        (once,) = [str(each.message) for each in said if "record=" in str(each.message)]
        raise ConfigurationError(once)  # to the other process

    assert "log.csv': no more is recorded: No space left" in in_a_process(fill)
    lines = file.read_text().splitlines(keepends=True)
    assert {line.count(",") for line in lines} == {lines[0].count(",")} and lines[-1].endswith("\n")


def test_no_folder_is_made_before_something_is_recorded(tmp_path):
    Recorder(tmp_path / "folder" / "log.csv")
    assert not list(tmp_path.iterdir())


def test_files_that_cannot_be_used(tmp_path):
    (tmp_path / "log.csv").write_text("mine")
    for file, words in (
        (tmp_path / "log.csv", r"log\.csv'?: is there already; expected a new"),
        (5, r"record=5: expected a new file NAME\.csv"),
        ("log.parquet", r"expected a file \.csv"),
        (tmp_path / "log.csv" / "log.csv", "cannot be written"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            record(policy, file)
    assert (tmp_path / "log.csv").read_text() == "mine"


def test_a_controller_records_nothing(tmp_path):
    with pytest.raises(ConfigurationError, match="record"):
        record(controller, tmp_path / "log.csv")
    assert not list(tmp_path.iterdir())


def test_a_copy_does_not_record_and_says_so(tmp_path):
    recorder = Recorder(tmp_path / "log.csv")
    with pytest.warns(UserWarning, match="a copy does not record"):
        copied = deepcopy(recorder)
    model, state, action = Dubins(), torch.zeros(3), torch.zeros(2)
    copied.acted(state, action, action)
    copied.observed(model, torch.ones(2), state + 0.1)
    assert not (tmp_path / "log.csv").exists()
