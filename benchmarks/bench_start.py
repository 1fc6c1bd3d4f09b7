"""Times of commands from a cold start, each with its limit.

    python benchmarks/bench_start.py
    python benchmarks/bench_start.py torchrl step

Processor time (s) of a process and its children, one thread, the smallest of some rounds; for the
demo the wall time on two cores. Times grow on a busy machine, and the time of ``import
torchrl.data`` shows by how much: the last column is in units of it. Its limit is that of a quiet
machine, on which ``import torchrl.data`` takes 2.6 s.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import torch
from hydra import compose, initialize_config_module

from afm_rl.missions import build, prepare
from afm_rl.report.tables import markdown
from afm_rl.storage.files import csv_text
from afm_rl.storage.manifest import write_manifest

HERE, BIN = Path(__file__).parents[1], Path(sys.executable).parent
WRAPPER = """
import gymnasium
from afm_rl import ActionFlowWrapper
env = ActionFlowWrapper(gymnasium.make("InvertedPendulum-v5"), model="mujoco")
env.reset(seed=0)
env.step(env.action_space.sample())
"""


def processor_time(*command: str | Path) -> float:
    """Return the processor time of a command (s)."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    settings = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    out, err = subprocess.PIPE, subprocess.PIPE
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(command, cwd=folder, env=settings, stdout=out, stderr=err, text=True)
    if done.returncode:
        raise SystemExit(f"{command}: {done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def python(code: str) -> float:
    """Return the processor time of a program (s)."""
    return processor_time(sys.executable, "-c", code)


def first_step() -> float:
    """Return the processor time of ``afm-rl method=afm_physics`` up to its first step (s)."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["checkpoints.every=0", f"hydra.run.dir={folder}"]  # a file after each step
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        process = subprocess.Popen(
            [BIN / "afm-rl", "method=afm_physics", *settings],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
        )
        while not any(Path(folder, "unfinished").glob("checkpoint-*")):
            if process.poll() is not None:
                raise SystemExit("afm-rl ended before its first step")
            time.sleep(0.002)
        process.kill()
        process.wait()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def diagnose() -> float:
    log = HERE / "examples" / "real_logs" / "warthog_ice.csv"
    return processor_time(BIN / "afm-rl-diagnose", log, "--no-page")


def report(methods: int = 4, copies: int = 23) -> float:
    """Return the time of a report: 22 missions, copied for 23 seeds of each of 4 methods."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder, "one")
        settings = ["regimes=paper", "tracks=all", "budget=400"]
        shown = ["figures=false", "tensorboard=false", f"hydra.run.dir={run}"]
        processor_time(BIN / "afm-rl", "method=afm_physics", *settings, *shown)
        missions, steps = pd.read_csv(run / "missions.csv"), pd.read_parquet(run / "steps.parquet")
        number, copied = len(missions), range(copies)
        steps = pd.concat([steps.assign(mission=steps["mission"] + number * k) for k in copied])
        seeds = [missions.assign(seed=k, mission=missions["mission"] + number * k) for k in copied]
        folders = []
        for method in range(methods):
            own = Path(folder, f"method_{method}")
            own.mkdir()
            (own / "measures.json").symlink_to(run / "measures.json")
            (own / "missions.csv").write_text(csv_text(pd.concat(seeds).assign(method=own.name)))
            steps.to_parquet(own / "steps.parquet", index=False)
            write_manifest(own)
            folders.append(own)
        return processor_time(BIN / "afm-rl-report", *folders, "--out", Path(folder, "report"))


def ensemble() -> float:
    """Return the training time of the demo's ensemble, and print its held-out error."""
    torch.set_num_threads(1)
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        agent = build(compose("config", ["method=online_pe"]))
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        prepare(agent, folder)  # at most 0.004 standard deviations
        return time.process_time() - start


def demo() -> float:
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        settings = [f"cache={folder}/cache", "budget=400", "video=gif"]
        processor_time(BIN / "afm-rl", f"hydra.run.dir={folder}/demo", *settings)
        return time.perf_counter() - start


def mission(*settings: str) -> float:
    return processor_time(BIN / "afm-rl", "method=afm_physics", *settings)


ROWS: dict[str, tuple[str, float, int, Callable[[], float]]] = {
    "wrapper": ("wrapper: import, reset, first step", 1.3 * 2.6, 3, lambda: python(WRAPPER)),
    "settings": (
        "afm-rl --cfg job",
        0.7,
        3,
        lambda: processor_time(BIN / "afm-rl", "--cfg", "job"),
    ),
    "torchrl": ("import torch, torchrl", 3.6, 3, lambda: python("import torch, torchrl")),
    "step": ("afm-rl method=afm_physics, up to the first step", 2 * 3.6, 3, first_step),
    "steps": ("afm-rl method=afm_physics budget=50", 4.5, 3, lambda: mission("budget=50")),
    "regime": (
        *("three missions under a regime", 8.0, 1),
        lambda: mission("regimes=[{v_gain: -1.7, omega_gain: 0.6}]", "seeds=3"),
    ),
    "setting": (
        *("a mission with other settings", 8.0, 1),
        lambda: mission("planner.horizon=8", "corrector.nominal_log_odds=4"),
    ),
    "diagnose": ("afm-rl-diagnose of a real log, no page", 2.5, 3, diagnose),
    "report": ("report of 2,024 missions", 8.0, 1, report),
    "ensemble": ("ensemble of the demo, held-out error at most 0.004", 8.0, 1, ensemble),
    "demo": ("make demo, after set-up", 20.0, 1, demo),
}
"""By name: what it is, its limit (s), how many rounds, and what measures it."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", choices=[[], *ROWS], default=list(ROWS))
    asked, took = parser.parse_args().rows, dict[str, float]()
    unit = min(python("import torchrl.data") for _ in range(3))
    print(f"import torchrl.data: {unit:.2f} s\n")
    heads, rows = ["", "s", "at most, quiet", "in imports of torchrl.data", "at most"], []
    for name in asked:
        what, limit, rounds, measure = ROWS[name]
        spent = took[name] = min(measure() for _ in range(rounds))
        numbers = (spent, limit, spent / unit, limit / 2.6)
        rows.append([what, *(f"{number:.1f}" for number in numbers)])
    print(markdown("start", pd.DataFrame(rows, columns=heads)))
    if {"torchrl", "step"} <= took.keys():
        ratio = took["step"] / took["torchrl"]
        print(f"\nThe first step takes {ratio:.2f} times as long as importing torchrl; at most 2.")


if __name__ == "__main__":
    main()
