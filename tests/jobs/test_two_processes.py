"""Two processes give the same bytes, whatever the method, over many steps."""

import pytest
from harness import shrink

from afm_rl.jobs.batch import run_batch
from afm_rl.jobs.executor import Executor
from afm_rl.jobs.layout import job_folders
from afm_rl.storage.manifest import check_manifest

METHODS = ["online_pe", "afm_physics", "rls"]


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(configure, tmp_path, here):
    """New processes train the parts, this old one finds them in the cache."""
    jobs = {}
    for method in METHODS:
        cfg = configure(method, budget=30, cache=str(tmp_path / "cache"))
        jobs[method] = shrink(cfg)
    assert run_batch(tmp_path / "new", jobs, Executor(2), echo=lambda line: None) == {}
    assert run_batch(tmp_path / "old", jobs, here, echo=lambda line: None) == {}
    for one, other in zip(*(job_folders(tmp_path / name) for name in ("new", "old")), strict=True):
        sums = check_manifest(one), check_manifest(other)
        for name in ("missions.csv", "steps.parquet"):
            assert sums[0][name] == sums[1][name], one.name
