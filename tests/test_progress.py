"""Progress bars: of processes that are killed."""

import multiprocessing
import os
import signal
import time

from afm_rl.progress import Bar, waiting


def show_one():
    for _ in Bar(range(2), desc="one"):
        pass


def hold():
    with Bar.get_lock():
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_killed_while_it_shows_progress_stops_no_other():
    show_one()  # the forked processes inherit whatever lock a bar has made
    fork = multiprocessing.get_context("fork").Process
    for target, status in (hold, -signal.SIGKILL), (show_one, 0):
        process = fork(target=target)
        process.start()
        process.join(60)
        process.kill()
        process.join()
        assert process.exitcode == status


def test_a_training_before_the_work_is_no_share_of_it(monkeypatch):
    heard = []
    monkeypatch.setattr(Bar, "listener", heard.append)
    for main in (False, True):
        for _ in Bar(range(3), main=main, mininterval=0.0):
            assert main or {*heard} <= {0.0}
    assert heard == sorted(heard) and heard[-1] == 1.0


def test_what_takes_longer_than_expected_is_nearly_done():
    with waiting("compiling", expected=0.03, every=0.01) as bar:
        while bar.n < 0.1:
            time.sleep(0.01)
    assert 0.03 < bar.n < bar.total < 1.2 * bar.n
