"""Whether stream-x learns faster with eligibility traces, or after other pre-training.

    python benchmarks/bench_traces.py

Stream-x of agent=paper, which descends the likelihood, learns from the transitions of
`bench_layers.py`. Elsayed et al. (2024) use traces of gamma 0.99 times lambda 0.8. Pre-training
*as published* stops when the held-out loss hardly changes; *short* is one pass over fewer samples;
*thorough* is that of this library. Prints the error that `bench_layers.py` prints.
"""

from __future__ import annotations

import argparse

import pandas as pd
from bench_layers import errors, pretrained

from afm_rl.report.tables import markdown

SHORT = ["dynamics.pretrain.samples=5000", "dynamics.pretrain.epochs=1"]
THOROUGH = [f"dynamics.pretrain.{x}" for x in ("epochs=16", "lr=2e-3", "tolerance=0")]
THOROUGH += ["dynamics.pretrain.one_cycle=true"]
PRETRAINED = {"as published": [], "short": SHORT, "thorough": THOROUGH}
TRACES = {"none": 0.0, "0.99 · 0.8": 0.792}

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rows = []
    for pretraining, settings in PRETRAINED.items():
        for name, trace in TRACES.items():
            agent = pretrained("method=stream_x_pe", f"updater.trace={trace}", *settings)
            rows.append({"pre-training": pretraining, "traces": name} | errors(agent))
    print(markdown("stream-x: error of the change of x", pd.DataFrame(rows)))
