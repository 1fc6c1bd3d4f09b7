"""Logs in files of others: MCAP, and data sets of LeRobot."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
from mcap.writer import Writer

LOGS = Path(__file__).parents[2] / "examples" / "real_logs"


def mcap_of(path, *topics, **how):
    """Write an MCAP file.

    Of each topic are given its name, begin and period (s), and contents; then the encoding and
    name and text of its schema, if it is no JSON.
    """
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start()
        for topic, begin, period, contents, *kind in topics:
            encoding, name, text = kind or ("json", "any", b"")
            schema = writer.register_schema(name, "ros1msg" if text else "jsonschema", text)
            channel = writer.register_channel(topic, encoding, schema)
            for k, content in enumerate(contents):
                t = int(1e9 * (begin + period * k))
                data = content if isinstance(content, bytes) else json.dumps(content).encode()
                writer.add_message(channel, t, data, t)
        writer.finish()
    return path


def data_set_of(folder, episodes, names=None, **info):
    """Write a data set at 30 Hz, a file for the commands and responses of each episode."""
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    for number, (u, y) in enumerate(episodes):
        table = pd.DataFrame({"action": list(u), "observation.state": list(y)})
        seconds = (np.arange(len(u)) / 30).astype(np.float32)
        table = table.assign(episode_index=number, timestamp=seconds)
        table.to_parquet(chunk / f"episode_{number:06d}.parquet")
    feature = {"dtype": "float32", "shape": [u.shape[1]], "names": names}
    features = {"action": feature, "observation.state": feature}
    (folder / "meta").mkdir()
    text = json.dumps({"fps": 30, "features": features, **info})
    (folder / "meta" / "info.json").write_text(text)
    return folder
