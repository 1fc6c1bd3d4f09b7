"""What a diagnosis takes, beside one fit by least squares to the same log.

    python benchmarks/bench_diagnosis.py --rows 100000 --joints 7
    python benchmarks/bench_diagnosis.py --rows 10000 --joints 1

Processor time of one thread, beside the limit for a joint of 10,000 rows.
Every second joint is reversed and weak, the last one is late.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from timing import timed

from afm_rl.diagnosis import Log, diagnose

LIMIT = 0.2
"""Of a joint of 10,000 rows (s), on a machine that does nothing else."""


def simulate(rows: int, joints: int, smooth: bool) -> Log:
    """Return a log of commands, white or smooth, and of what the joints made of them."""
    rng = np.random.default_rng(0)
    command = rng.uniform(-1, 1, (rows, joints))
    if smooth:
        kernel = np.hanning(40) / np.hanning(40).sum()
        command = np.stack([3 * np.convolve(u, kernel, "same") for u in command.T], 1)
    response = command * np.where(np.arange(joints) % 2, -0.5, 1.0)
    response[2:, -1] = command[:-2, -1]
    names = tuple(f"joint_{j}" for j in range(joints))
    return Log(names, command, response + rng.normal(0, 0.02, response.shape))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--joints", type=int, default=7)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    for kind in ("white", "smooth"):
        log = simulate(args.rows, args.joints, kind == "smooth")
        jobs = {
            "diagnosis": lambda log=log: diagnose(log),
            "one least-squares fit": lambda log=log: np.linalg.lstsq(log.command, log.response),
        }
        for name, spent in timed(jobs, args.rounds, 1, time.thread_time).items():
            small = name == "diagnosis" and (args.rows, args.joints) == (10_000, 1)
            limit = f" (limit {LIMIT} s)" * small
            print(f"{kind} commands, {name}: {np.median(spent) / 1e3:.2f} s{limit}")


if __name__ == "__main__":
    main()
