"""Time of `afm_rl.compare`: HalfCheetah, nine faults, two methods, three episodes of 300 steps.

    python benchmarks/bench_compare.py

The policy was trained by others. Seconds of the whole call on one thread, without imports.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import pandas as pd
import torch

from afm_rl import compare
from afm_rl.report.tables import markdown

POLICIES = Path(__file__).parents[1] / "examples" / "policies" / "zoo"
LIMIT = 90.0  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    args = parser.parse_args()
    torch.set_num_threads(1)
    wall, spent = time.perf_counter(), time.process_time()
    policy = POLICIES / "half_cheetah_tqc.safetensors"
    found = compare("HalfCheetah-v5", policy, steps=args.steps, progress=False)
    times = {
        "elapsed": time.perf_counter() - wall,
        "of processor time": time.process_time() - spent,
    }
    print(found)
    rows = [[what, f"{seconds:.0f}", f"{LIMIT:.0f}"] for what, seconds in times.items()]
    print(markdown("seconds of compare", pd.DataFrame(rows, columns=["time", "s", "at most"])))


if __name__ == "__main__":
    main()
