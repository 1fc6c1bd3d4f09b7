"""Faults that policies of the zoo meet besides the presets."""

from __future__ import annotations

from afm_rl.regimes.presets import Fault

LATER: dict[str, Fault] = {
    "late 3": {"delay": 3},
    "late 5": {"delay": 5},
    "late 9": {"delay": 9},
    "late 12": {"delay": 12},
    "late 13": {"delay": 13},
    "late 25": {"delay": 25},
    "late 0 to 3": {"random_delay": 3},
    "WiFi": {},  # it delays what actuators are told
}
RARE = ("lag 1", "lag 3", "rate .3", "rate .2", *LATER)
"""Faults that are played only if they are asked for."""
