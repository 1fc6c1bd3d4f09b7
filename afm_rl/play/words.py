"""What the page says of both robots."""

from __future__ import annotations

from typing import Any

import numpy as np

from afm_rl.play.world import SIDES, World


def text_of(world: World) -> str:
    """Say how both are, and what AFM knows."""
    sides, score = [world.sides[name] for name in SIDES], world.robot.score
    table = {"": SIDES, "---": ["---"] * 2, "falls": [side.falls for side in sides]}
    table["reward a step"] = [f"{mean(side.rewards):.2f}" for side in sides]
    if score != "reward":
        table[score] = [side.info.get(score, "") for side in sides]
    rows = ["| " + " | ".join(map(str, (name, *row))) + " |" for name, row in table.items()]
    afm, late = sides[1].info["afm"], world.faults.values.get("delay", 0)
    state = "**corrects**" if afm["corrects"] else "does nothing"
    lines = [f"AFM {state}; innovation {afm['innovation']:.3g}"]
    if f"{late:.0f} steps late" not in afm["belief"] and late > 1:
        lines.append(f"{late:.0f} steps are more than AFM looks back: it cannot find that")
    belief = believed(world.robot.names, afm["belief"], afm["noise"])
    return "\n".join([*rows, "", "  \n".join(lines), "", *belief])


def faults_of(world: World) -> str:
    """Say what the actuators seem to do that they should not."""
    words = str(world.sides["AFM"].env.diagnosis)
    for k, name in enumerate(world.robot.names):
        words = words.replace(f"actuator {k}:", f"{name}:").replace(f"a_{k}:", f"{name}:")
    return "  \n".join(x for x in words.splitlines() if not x.endswith(": healthy"))


def believed(names: list[str], belief: dict[str, np.ndarray], noise: np.ndarray) -> list[str]:
    """Return a table of what is believed most of each actuator, and of all on average.

    >>> believed(["joint"], {"1 step late": np.array([0.97])}, np.array([0.05]))[-1]
    '| joint | 1 step late | 97 | 0.05 |'
    """
    chances = np.stack(list(belief.values()))  # of causes and actuators
    if len(names) > 1:
        names, chances = [*names, "*mean*"], np.c_[chances, chances.mean(1)]
        noise = np.append(noise, noise.mean())
    rows = ["| actuator | believed | % | noise |", "|---|---|---|---|"]
    for name, chance, spread in zip(names, chances.T, noise, strict=True):
        cause = list(belief)[chance.argmax()]
        rows.append(f"| {name} | {cause} | {100 * chance.max():.0f} | {spread:.2g} |")
    return rows


def mean(values: Any) -> float:
    """Return the mean of the newest 50 values."""
    newest = list(values)[-50:]
    return sum(newest) / max(len(newest), 1)
