"""Collect with TorchRL's collector into a buffer on disk, and sample from it.

    python examples/torchrl/collect.py

Each transition has the planned action, the executed action, and the entries of the correction. To
learn a *policy*, use the planned action, ``"action"``, because its log-probability is known. To
learn a *model*, use the executed action, ``("next", "afm", "executed_action")``.
"""

import argparse
import tempfile

import torch
from swing_up import make_env
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--frames", type=int, default=2000)
asked = parser.parse_args()

torch.set_num_threads(1)
torch.manual_seed(0)
env = make_env()
env.set_seed(0)
collector = Collector(env, None, frames_per_batch=100, total_frames=asked.frames)  # at random
with tempfile.TemporaryDirectory() as folder:
    buffer = TensorDictReplayBuffer(
        storage=LazyMemmapStorage(asked.frames, scratch_dir=folder), batch_size=32
    )
    for batch in collector:
        buffer.extend(batch)
    collector.shutdown()
    sample = buffer.sample()
    planned, executed = sample["action"], sample["next", "afm", "executed_action"]
    corrected = sample["next", "afm", "corrected"]
    print(f"{len(buffer)} transitions of {sample.bytes() // len(sample)} bytes each")
    print(f"{corrected.float().mean():.0%} of a sample are corrected; of these")
    print(f"executed / planned: {(executed / planned)[corrected].median():+.2f}")
