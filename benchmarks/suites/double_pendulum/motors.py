"""What the motors of RealAIGym's robot do, by `afm-rl-diagnose`: commanded and measured torque.

    python benchmarks/suites/double_pendulum/motors.py --data data/double_pendulum_repository

The folder is a copy of github.com/dfki-ric-underactuated-lab/double_pendulum.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from plant import DRIVEN

from afm_rl.diagnosis import Actuator, diagnose
from afm_rl.diagnosis.readers import read_log
from afm_rl.report.tables import markdown

RECORDS, BOARDS = "data/experiment_records", "leaderboard"
LOGS = {  # folders, and the Coulomb friction of the driven joint that was identified, N m
    "pendubot, TVLQR (A.0)": (f"{RECORDS}/design_A.0/20220819/*tvlqr_lqr", 0.093),
    "acrobot, LQR (C.0)": (f"{RECORDS}/design_C.0/20220914/*acrobot_lqr*", 0.078),
    "acrobot, TVLQR (C.0)": (f"{RECORDS}/design_C.0/20220914/*tvlqr*", 0.078),
    "pendubot, TVLQR (C.1)": (f"{BOARDS}/pendubot/real_hardware_v2/*/ilqr*/*0[1-3]", 0.16),
    "pendubot, SAC (C.1)": (f"{BOARDS}/pendubot/real_hardware_v2/*/sac*/*0[357]", 0.16),
    "acrobot, TVLQR (C.1)": (f"{BOARDS}/acrobot/real_hardware_v2/*/ilqr*/*0[1-3]", 0.12),
    "acrobot, MC-PILCO (C.1)": (f"{BOARDS}/acrobot/real_hardware_v2/*/mcp*/*0[1-3]", 0.12),
}
HEADS = ["gain", "delay (ms)", "lag (ms)", "noise (N m)", "unexplained (%)", "dead zone (N m)"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="a copy of their repository")
    args = parser.parse_args()
    rows = []
    for name, (pattern, friction) in LOGS.items():
        joint = DRIVEN[name.partition(",")[0]] + 1
        fields = [f"motor=tau_con{joint}"], [f"motor=tau_meas{joint}"]
        files = sorted(args.data.glob(f"{pattern}/trajectory.csv"))
        motors = [diagnose(read_log(file, *fields)).actuators[0] for file in files]
        clear = [m for m in motors if m.status != "cannot tell" and m.unexplained < 0.5]
        cells = [f"{x:.2g}" for x in np.median([*map(numbers, clear)], 0)] if clear else ["–"] * 6
        peak = f"{np.pi / 2 * friction:.2f}"  # of friction that is cf * arctan(100 * speed)
        rows.append([name, f"{len(clear)}/{len(motors)}", *cells, peak])
    heads = ["controller (design)", "logs", *HEADS, "friction, identified (N m)"]
    print(markdown("motors", pd.DataFrame(rows, columns=heads)))


def numbers(motor: Actuator) -> list[float]:
    """Return what a row of the table shows of a log."""
    times = [1e3 * motor.delay_s, 1e3 * motor.lag_s]
    return [motor.gain, *times, motor.noise, 100 * motor.unexplained, motor.dead_zone]


if __name__ == "__main__":
    main()
