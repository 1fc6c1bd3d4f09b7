"""Checks of settings that no part can make alone, before anything is trained."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from tensordict import unravel_key
from torchrl.envs import EnvBase

from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.mujoco_model import check_files
from afm_rl.errors import ConfigurationError
from afm_rl.learning import Updater
from afm_rl.planning import Cost
from afm_rl.trust import leaves, trusted_folders


def check_models(settings: Mapping[str, Any]) -> None:
    """Check that an MJCF that resolved settings name, wherever, reads no files of other folders.

    Raises:
        ConfigurationError: naming setting and file, see ``check_files``.
    """
    folders = trusted_folders()
    for place, _, value in leaves(settings):
        if isinstance(value, str):
            check_files(place, value, folders)


def check_label(label: Any) -> str | None:
    """Return the name of a method, which becomes that of a file, too: it must not lead elsewhere.

    >>> check_label("physics+corrector=l1")
    'physics+corrector=l1'
    """
    if label is None:
        return None
    if not isinstance(label, str) or not re.fullmatch(r"(?!\.)[^/\\\x00-\x1f]{1,200}", label):
        raise ConfigurationError(
            f"label={label!r:.80}: expected a text of up to 200 characters without / and \\, which "
            "does not begin with a dot"
        )
    return label


def check_updater(updater: Updater, model: DynamicsModel) -> None:
    """Check that the updater sets what the model is conditioned on, and nothing else."""
    wanted, given = model.conditioned_on, updater.sets
    optional = wanted == "calibration" and not updater.learns  # without one it is the identity
    if wanted == given or (given is None and optional):
        return
    if "regime" in (wanted, given):
        raise ConfigurationError(
            "dynamics=oracle needs an updater that sets its regime, and the reverse: choose "
            "dynamics=oracle with updater=oracle, or neither"
        )
    raise ConfigurationError(
        f"dynamics: of a calibrated model only the calibration changes, and "
        f"{type(updater).__name__} does not set it; choose updater=rls or updater=frozen"
    )


def check_cost(cost: Cost, env: EnvBase, stages: int | None = None) -> None:
    """Check that the environment gives what the cost reads.

    ``stages`` says how many numbers in a row, one per planned state, the planner takes; None: only
    one.
    """
    spec = env.observation_spec
    for key, size in zip(cost.in_keys, cost.in_sizes, strict=True):
        given = spec[key].shape[-1] if key in spec.keys(True, True) else "nothing"
        if given != size:
            raise ConfigurationError(
                f"cost: reads {size} numbers from {key!r}, but the environment gives {given} there"
            )
        batch = env.observation_spec.shape
        rows = spec[key].shape[len(batch) : -1]
        if rows and rows != (stages,):
            wanted = "one" if stages is None else f"one or {stages}"
            raise ConfigurationError(
                f"planner: the environment gives {rows.numel()} successive targets in {key!r}, but "
                f"the planner takes {wanted}; choose planner=mpc with the environment's horizon"
            )


def check_keys(group: str, part: Any, env: EnvBase) -> None:
    """Check that the entries that a part was told to read are there."""
    given = list(env.observation_spec.keys(True, True))
    for name in ("seed_key", "regime_key", "bounds_key"):
        key = getattr(part, name, None)
        if key is not None and unravel_key(key) not in given:
            raise ConfigurationError(
                f"{group}.{name}={key!r}: expected one of {', '.join(map(repr, given))}"
            )
