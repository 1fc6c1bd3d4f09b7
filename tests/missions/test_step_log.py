"""The log of steps."""

import torch

from afm_rl.missions.state import StepLog


def test_steps_are_ordered_by_mission_whatever_left_the_batch():
    log = StepLog(["x"])
    for step, missions in enumerate(([0, 1, 2], [0, 2], [2])):
        log.add(torch.tensor(missions), step, torch.tensor(missions).unsqueeze(-1) + step / 10)
    table = log.table()
    assert table["mission"].tolist() == [0, 0, 1, 2, 2, 2]
    assert table["t"].tolist() == [0, 1, 0, 0, 1, 2]
    torch.testing.assert_close(table["x"].tolist(), [0.0, 0.1, 1.0, 2.0, 2.1, 2.2])


def test_a_log_grows_without_losing_rows():
    log, missions = StepLog(["step", "even"], whole=["even"], room=10), torch.arange(3)
    for step in range(8):
        values = torch.full((len(missions), 2), float(step))
        values[:, 1] = missions % 2 == 0
        log.add(missions, step, values)
    table = log.table()
    assert len(table) == 24
    assert table["step"].eq(table["t"]).all()
    assert table["even"].eq(1 - table["mission"] % 2).all()
    assert table.dtypes.astype(str).tolist() == ["int32", "int32", "float32", "int32"]


def test_a_log_grows_on_after_it_was_taken_up():
    log, again = StepLog(["x"], room=4), StepLog(["x"], room=4)
    log.add(torch.arange(3), 0, torch.ones(3, 1))
    again.load_state_dict(log.state_dict())
    for both in (log, again):
        for step in range(1, 30):
            both.add(torch.arange(2), step, torch.full((2, 1), float(step)))
    assert len(again) == 3 + 2 * 29
    assert log.table().equals(again.table())
