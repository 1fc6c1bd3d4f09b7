"""Whether stream-x learns faster with eligibility traces, or after less pre-training.

    python benchmarks/bench_traces.py

Stream-x of agent=paper, which descends the likelihood, learns from the transitions of
`bench_layers.py`. Elsayed et al. (2024) use traces of gamma 0.99 times lambda 0.8. Pre-training is
shorter than published: 4 epochs, or one epoch of a tenth of the samples. Prints the error that
`bench_layers.py` prints.
"""

from __future__ import annotations

import argparse

import pandas as pd
from bench_layers import errors, pretrained

from afm_rl.report.tables import markdown

PRETRAINING = {"4 epochs": [4, 50_000], "1 epoch, a tenth of the samples": [1, 5_000]}
TRACES = {"none": 0.0, "0.99 · 0.8": 0.792}

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rows = []
    for pretraining, (epochs, samples) in PRETRAINING.items():
        data = [f"dynamics.pretrain.epochs={epochs}", f"dynamics.pretrain.samples={samples}"]
        for name, trace in TRACES.items():
            agent = pretrained("method=stream_x_pe", f"updater.trace={trace}", *data)
            rows.append({"pre-training": pretraining, "traces": name} | errors(agent))
    print(markdown("stream-x: error of the change of x", pd.DataFrame(rows)))
