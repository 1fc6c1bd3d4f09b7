"""How often a diagnosis is right, on logs with random faults: ``python tests/diagnosis/score.py``.

Each actuator has with 70 % chance one to three faults. Printed are shares of all actuators.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
from simulate import Fault, commands, noise, respond

from afm_rl.diagnosis import Actuator, Log, diagnose

NAMES = tuple("abcdefg")
KINDS = ("gain", "reversed", "offset", "dead_zone", "saturation", "backlash", "delay", "lag")
KINDS += ("source", "coupling", "quantum")


def draw_fault(rng: np.random.Generator, j: int, size: int) -> Fault:
    """Draw what actuator j of some has, if anything."""
    fault = Fault()
    if rng.random() > 0.7:
        return fault
    kinds = set(rng.choice(KINDS, rng.integers(1, 4), replace=False))
    other = int((j + rng.integers(1, size)) % size)
    if "gain" in kinds:
        fault.gain *= rng.choice([0.3, 0.5, 0.62, 0.8, 1.3, 2.0])
    if "reversed" in kinds:
        fault.gain *= -1
    if "offset" in kinds:
        fault.offset = rng.choice([-1, 1]) * rng.uniform(0.1, 0.5)
    if "dead_zone" in kinds:
        fault.dead_zone, fault.jump = rng.uniform(0.08, 0.35), bool(rng.random() < 0.3)
    if "saturation" in kinds:
        fault.saturation = rng.uniform(0.4, 0.7)
    if "backlash" in kinds:
        fault.backlash = rng.uniform(0.06, 0.25)
    if "delay" in kinds:
        fault.delay = float(rng.choice([1, 1.5, 2, 2.5, 4, 7]))
    if "lag" in kinds:
        fault.lag = float(rng.choice([1, 2, 4, 8]))
    if "source" in kinds:
        fault.source = other
    elif "coupling" in kinds:
        fault.coupling = (other, rng.choice([-1, 1]) * rng.uniform(0.2, 0.5))
    if "quantum" in kinds:
        fault.quantum = 0.03
    return fault


def score(fault: Fault, found: Actuator) -> dict[str, bool]:
    """Return what is right."""
    cut, seen = fault.saturation, found.saturation
    plain = Fault(quantum=fault.quantum)  # a coarse sensor alone is no fault
    other = fault.source if fault.coupling is None else fault.coupling[0]
    return {
        "status": (found.status == "changed") == (fault != plain),
        "gain, within 6 %": abs(found.gain - fault.gain) < 0.06 * max(1, abs(fault.gain)),
        "gain, inside its interval": found.gain_interval[0] <= fault.gain <= found.gain_interval[1],
        "sign": bool(found.reversed) == (fault.gain < 0),
        "offset, within 0.05": abs(found.offset - fault.offset) < 0.05,
        "dead zone, within 0.05": abs(found.dead_zone - fault.dead_zone) < 0.05,
        "saturation, within 0.06": (
            cut is None if seen is None else cut is not None and abs(seen - cut) < 0.06
        ),
        "backlash, within 0.04": abs(found.backlash - fault.backlash) < 0.04,
        "delay and lag together, within 0.7 steps": (
            abs(found.delay_s + found.lag_s - fault.delay - fault.lag) < 0.7
        ),
        "delay alone, within 0.7 steps": abs(found.delay_s - fault.delay) < 0.7,
        "driven by": found.driven_by == (None if other is None else NAMES[other]),
        "no change on the way": not found.changes and not found.drift,
    }


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=100)
    right, actuators, healthy, alarms = Counter(), 0, 0, 0
    for seed in range(parser.parse_args().logs):
        rng = np.random.default_rng(seed)
        size, rows = int(rng.integers(2, 8)), int(rng.choice([300, 600, 1500, 4000]))
        kind = str(rng.choice(["white", "steps", "walk", "smooth"]))
        sort, scale = str(rng.choice(["gauss", "heavy", "red"])), rng.choice([0.003, 0.01, 0.03])
        u = commands(rng, rows, size, kind)
        faults = [draw_fault(rng, j, size) for j in range(size)]
        y = np.column_stack([respond(u, fault, j) for j, fault in enumerate(faults)])
        found = diagnose(Log(NAMES[:size], u, y + noise(rng, rows, size, scale, sort)))
        for fault, actuator in zip(faults, found.actuators, strict=True):
            points = score(fault, actuator)
            right.update(name for name, good in points.items() if good)
            right["everything but the interval"] += all(
                good for name, good in points.items() if "inside" not in name
            )
            actuators += 1
            if fault == Fault():
                healthy += 1
                alarms += actuator.status != "healthy"
    print(f"{actuators} actuators, {healthy} of them healthy, {alarms} false alarms")
    for name, count in right.items():
        print(f"{100 * count / actuators:5.1f} %  {name}")


if __name__ == "__main__":
    main()
