"""What packages say while their files are loaded."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


@contextmanager
def quiet() -> Iterator[None]:
    """Silence what packages say of missing screens, and of old settings in files of theirs."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings(), _deprecations_of_mujoco_unsaid():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logger.setLevel(level)
            absl: Any = sys.modules.get("absl.logging")
            if absl is not None:  # it would close what stood for stderr when it was imported
                absl.get_absl_handler().python_handler.stream = sys.__stderr__


@contextmanager
def _deprecations_of_mujoco_unsaid() -> Iterator[None]:
    try:
        from mujoco import get_mju_user_warning, set_mju_user_warning
    except ImportError:  # an extra
        yield
        return
    before = get_mju_user_warning()
    tell = partial(print, file=sys.stderr) if before is None else before
    set_mju_user_warning(lambda text: None if "deprecated" in text else tell(text))
    try:
        yield
    finally:
        set_mju_user_warning(before)
