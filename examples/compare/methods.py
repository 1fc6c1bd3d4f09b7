"""Compare methods from Python: the same missions, one table.

    python examples/compare/methods.py

What `afm-rl "compare=[...]"` does, step by step: configuration, agent, trained parts, missions.
"""

import argparse

import pandas as pd
from hydra import compose, initialize_config_module

from afm_rl.missions import build, prepare, run
from afm_rl.report import print_summary

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--methods", nargs="+", default=["physics", "adaptive_gain", "oracle"])
parser.add_argument("--budget", type=int, default=800, help="steps of a mission")
asked = parser.parse_args()

tables = []
for method in asked.methods:
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        cfg = compose("config", [f"method={method}", f"label={method}", "seeds=2"])
    cfg.budget = asked.budget
    agent = build(cfg)  # everything is checked here
    prepare(agent, cfg.cache, progress=True)  # trains what is not in the cache; nothing, here
    results = run(agent)
    tables.append(results.missions)
print_summary(pd.concat(tables), results.measures)
