"""Jobs on a Ray cluster: two nodes, both on this machine."""

import pytest

ray = pytest.importorskip("ray")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def address():
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    yield cluster.address
    cluster.shutdown()


def test_jobs_run_on_both_nodes_and_one_that_dies_takes_no_other_with_it(
    afm_rl, address, tmp_path, monkeypatch
):
    def meet(job):  # here and not above: functions inside others are sent whole
        import os
        import time

        import ray

        from afm_rl.storage.manifest import write_manifest

        if "seeds=3" in job.name:
            os._exit(3)
        (job.folder / f"{job.name}.node").write_text(ray.get_runtime_context().get_node_id())
        while len(list(job.folder.parent.glob("*/*.node"))) < 2:  # needs both at the same time
            time.sleep(0.1)
        (job.folder / "unfinished" / "config.yaml").unlink()
        write_manifest(job.folder, [])

    monkeypatch.setattr("afm_rl.jobs.executor.run", meet)
    where = ["launcher=ray", f"hydra.launcher.address={address}", f"hydra.sweep.dir={tmp_path}"]
    done = afm_rl("-m", "method=physics", "seeds=1,2,3", *where)
    assert done.status == 1
    nodes = {path.read_text() for path in tmp_path.glob("jobs/*/*.node")}
    assert nodes == {node["NodeID"] for node in known_nodes(address)} and len(nodes) == 2
    assert "physics+seeds=1: done" in done.out and "physics+seeds=2: done" in done.out
    assert "afm-rl: physics+seeds=3: failed: " in done.err and "1 of 3 jobs failed" in done.err


def known_nodes(address):
    with ray.init(address):
        return ray.nodes()
