"""ULog, the format of PX4."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from afm_rl.diagnosis.readers.messages import sorted_series
from afm_rl.diagnosis.readers.source import Series, Source
from afm_rl.errors import ConfigurationError, printable

TIME = "timestamp"  # in microseconds


def open_ulog(path: Path) -> Source:
    """Return the fields of a ULog: ``TOPIC.FIELD``, or ``TOPIC[1].FIELD`` of a second instance.

    Raises:
        ConfigurationError: if it is no ULog, or if the package for it is missing.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise ConfigurationError("ULog needs pyulog: pip install 'afm-rl[logs]'") from error
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
            topics = {_name(data): data.data for data in ULog(file).data_list}
    except Exception as error:  # of a damaged file it raises whatever the bytes lead it to
        reason = printable(f"{type(error).__name__}: {error}", 120)
        raise ConfigurationError(f"no ULog, or a damaged one: {reason}") from error
    fields = {
        f"{topic}.{field}": (topic, field)
        for topic, data in topics.items()
        for field in data
        if field != TIME and TIME in data
    }

    def read(wanted: Sequence[str]) -> dict[str, Series]:
        found = {}
        for name in wanted:
            topic, field = fields[name]
            t = topics[topic][TIME].astype(float) / 1e6
            found[name] = sorted_series(topics[topic][field].astype(float), t)
        return found

    counts = {topic: len(data[TIME]) for topic, data in topics.items() if TIME in data}
    return Source(path, list(fields), read, topics=counts)


def _name(data: Any) -> str:
    return f"{data.name}[{data.multi_id}]" if data.multi_id else data.name
