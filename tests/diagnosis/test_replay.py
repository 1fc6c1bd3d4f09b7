"""A log replayed: what each command was predicted to do, from earlier rows only."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.signal import lfilter

from afm_rl.diagnosis import Log
from afm_rl.diagnosis.readers import read_log
from afm_rl.diagnosis.replay import replay
from afm_rl.diagnosis.replay.belief import believe, identity, watcher
from afm_rl.diagnosis.replay.table import (
    AFM,
    ALONE,
    Replayed,
    affine,
    arx,
    quantile_with_interval,
    removed_by,
    running_gain,
)

LOGS = Path(__file__).parents[2] / "examples" / "real_logs"


def make(rows=80, scale=(1.0, 1.0), noise=0.02, seed=0, **more):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (rows, 2))
    y = u * [-0.5, 1.0] + noise * rng.standard_normal(u.shape)
    return Log(("arm", "hand"), u * scale, y * scale, **more)


@pytest.fixture(scope="module")
def replayed():
    return replay(make())


def test_what_a_correction_would_have_removed(replayed):
    share = round(100 * replayed.removed["arm"])
    assert share > 85 and replayed.removed["hand"] == 0 and not replayed.slow
    said = f"A correction would have removed {share} % of the error of arm, and none of hand."
    assert replayed.sentence == said
    miss = np.abs(replayed.predictions[AFM] - replayed.log.response)[20:]
    assert np.median(miss) < 0.04
    assert 0.5 < np.mean(miss < replayed.std[20:])  # the noise is learnt


def test_a_fault_never_becomes_usual():
    """Nobody corrects a log: what a first fault does must not hide a second one."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (400, 1))
    gain = np.where(np.arange(400) < 200, -1.0, 0.5)[:, None]
    y = gain * u + 0.02 * rng.standard_normal(u.shape)
    miss = np.abs(replay(Log(("arm",), u, y)).predictions[AFM] - y)[300:]
    assert np.median(miss) < 0.02  # 0.11, if the first fault were usual


def test_no_row_depends_on_a_later_one(replayed):
    log = make()
    later = log.command.copy(), log.response.copy()
    later[0][50:] *= 7  # of another size, too
    later[1][50:] = np.random.default_rng(1).normal(0, 3, (30, 2))
    other = replay(Log(log.names, *later))
    for name, predicted in replayed.predictions.items():
        found = other.predictions[name][:50]
        np.testing.assert_allclose(found, predicted[:50], atol=1e-4, err_msg=name)
    np.testing.assert_allclose(other.std[:50], replayed.std[:50], atol=1e-4)


def test_units_do_not_matter(replayed):
    scale = (1e3, 1e-4)
    other = replay(make(scale=scale))
    for name, predicted in replayed.predictions.items():
        found = other.predictions[name] / scale
        np.testing.assert_allclose(found, predicted, atol=2e-3, err_msg=name)


@pytest.mark.slow
def test_no_effect_is_laid_to_a_command_beyond_a_border():
    """Each row is an episode's first or second; the second repeats the first's command late."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (100, 1))
    y = np.where(np.arange(100)[:, None] % 4 > 0, np.roll(u, 1, axis=0), 0.0)  # late by one row
    whole, cut = (
        replay(Log(("arm",), u, y, episode=episode)) for episode in (None, np.arange(100) // 4)
    )
    first = np.arange(100) % 4 == 0
    for table in (whole, cut):
        miss = np.abs(table.predictions[AFM] - y)[:, 0]
        assert np.median(miss[50:][~first[50:]]) < 0.2
    arx_miss = np.abs(cut.predictions["ARX"] - y)[50:][~first[50:]]
    assert np.median(arx_miss) < 0.05  # rows that begin an episode are not fitted


@torch.no_grad()
def test_a_row_is_what_the_corrector_predicts():
    log, corrector, model = make(rows=40), watcher(2), identity(2)
    unit = np.abs(log.command).max(0)
    u, y = (torch.as_tensor(x / unit, dtype=torch.float32) for x in (log.command, log.response))
    effects, stds = believe(corrector, log.command / unit, log.response / unit)
    box = torch.tensor([[-1.0, -1.0], [1.0, 1.0]])
    memory = corrector.begin(torch.zeros(3))
    for k in range(40):
        effect, std = corrector.predict(memory, u[k], model)
        np.testing.assert_allclose(effect, effects[k], atol=1e-5)
        np.testing.assert_allclose(std, stds[k], atol=1e-5)
        memory, _ = corrector.correct(memory, u[k], model, box)
        state = torch.cat([y[k], torch.tensor([1.0 - k % 2])])
        memory = corrector.observe(corrector.executing(memory, u[k], u[k]), state)


def test_a_response_that_is_held_between_messages_counts():
    log = make(rows=80)
    u, y = log.command[:, :1], np.repeat(-log.command[::4, :1], 4, axis=0)  # every fourth is new
    table = replay(Log(("arm",), np.repeat(u[::4], 4, axis=0), y))
    assert np.median(np.abs(table.predictions[AFM] - y)[40:]) < 0.05


def test_each_row_of_the_file_has_a_row(tmp_path):
    table = replay(make(rows=40)).rows()
    assert list(table) == ["t", *(f"{k}.{n}" for n in ("arm", "hand") for k in COLUMNS)]
    kept = table[["t", "command.arm", "response.arm"]].copy()
    kept.loc[[5, 38, 39], "response.arm"] = np.nan
    kept.to_csv(tmp_path / "log.csv", index=False)
    rows = replay(read_log(tmp_path / "log.csv")).rows()
    assert len(rows) == 40 and rows["afm.arm"].isna().to_numpy().nonzero()[0].tolist() == [
        5,
        38,
        39,
    ]


GOLDEN = Path(__file__).with_name("golden.csv")
COLUMNS = ("command", "response", "afm", "std")


def test_rows_are_those_that_were_stored():
    """To store them again: ``replay(make(rows=40)).rows().to_csv(GOLDEN, index=False)``."""
    stored, found = pd.read_csv(GOLDEN), replay(make(rows=40)).rows()
    near = {"rtol": 1e-5, "atol": 2e-3}  # single precision
    pd.testing.assert_frame_equal(found, stored, check_like=True, **near)


def test_what_is_written_is_a_log_again(tmp_path):
    episode = np.arange(90) // 30
    log = make(rows=90, t=0.1 * (np.arange(90) % 30), episode=episode)
    replay(log).rows().to_csv(tmp_path / "out.csv", index=False)
    again = read_log(tmp_path / "out.csv")
    assert again.names == log.names and again.begins.tolist() == log.begins.tolist()
    np.testing.assert_allclose(again.command, log.command)
    np.testing.assert_allclose(again.response, log.response)


def test_errors_are_those_of_the_rows(replayed):
    errors = replayed.errors.set_index(["actuator", "stretch", "predictor"])
    miss = np.abs(replayed.predictions[ALONE] - replayed.log.response)[:, 0]
    assert errors.loc[("arm", "all", ALONE), "median"] == np.median(miss)
    assert errors.loc[("arm", "2", ALONE), "p90"] == np.quantile(miss[20:40], 0.9)
    assert (errors["median_low"] <= errors["median"]).all()
    assert (errors["p90"] <= errors["p90_high"]).all()


def test_sentences():
    log = make(rows=30)

    def say(*shares):
        return Replayed(log, {}, log.command, None, dict(zip("abc", shares, strict=False))).sentence

    assert say(0.5, 0.7) == (
        "A correction would have removed 50 % of the error of a, and 70 % of the error of b."
    )
    assert say(0.0, 0.0) == "A correction would have removed none of a and b."
    assert say(0.5, 0.0, -0.2) == (
        "A correction would have removed 50 % of the error of a, and none of b, and added 20 % to "
        "that of c."
    )
    assert say(-0.2) == "A correction would have added 20 % to that of a."


def resting(rest, gain):
    """Return a log of a joint that rests a share of the time."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (600, 1))
    u *= np.repeat(rng.random((30, 1)) >= rest, 20, axis=0)
    return Log(("arm",), u, gain * u + 0.003 * rng.standard_normal(u.shape))


@pytest.mark.parametrize(("rest", "gain"), [(0.67, 0.5), (0.67, -1.0), (0.3, 0.5), (0.0, 0.5)])
def test_rows_at_rest_do_not_count(rest, gain):
    """A joint that rests most of the time: as commanded is right there, but for the noise."""
    log = resting(rest, gain)
    u = log.command
    assert removed_by(log, {ALONE: u, AFM: gain * u})["arm"] > 0.98
    assert removed_by(log, {ALONE: gain * u, AFM: gain * u})["arm"] == 0


def test_slow_actuators_are_named():
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, (10, 1)), 12, axis=0)
    table = replay(Log(("arm",), u, lfilter([0.1], [1.0, -0.9], u, axis=0)))
    assert table.slow == ("arm",) and table.notes[0].startswith("arm: commands act in later rows")


def test_intervals_hold_what_they_promise():
    """Of 300 draws, independent and alike, the interval holds the true median in 95 %."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal((300, 200))
    for values in (white, lfilter([1.0], [1.0, -0.6], white)):
        low, _, high = np.array([quantile_with_interval(v, 0.5) for v in values]).T
        assert 0.85 < np.mean((low < 0) & (high > 0)) < 0.99


def test_plain_methods_know_what_they_are_made_for():
    u = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    begins = np.zeros(200, bool)
    mixed = u @ [[0.5, 0.3], [0.0, -1.0]] + [0.2, 0.0]
    lag = lfilter([0.3], [1.0, -0.7], u, axis=0)
    for predict, y in ((running_gain, u * [-2.0, 0.1]), (affine, mixed), (arx, lag)):
        assert np.abs(predict(u, y, begins) - y)[100:].max() < 0.02, predict


def test_a_real_robot_on_ice():
    table = replay(read_log(LOGS / "warthog_ice.csv"))
    errors = table.errors[table.errors["stretch"] == "all"].set_index(["actuator", "predictor"])
    turn = errors.loc["yaw_rate", "median"]
    assert turn[AFM] < 0.3 * turn[ALONE] and turn[AFM] < 1.3 * turn.drop([AFM, ALONE]).min()
    assert "of the error of yaw_rate" in table.sentence
