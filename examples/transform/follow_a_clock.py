"""Follow a reference that moves with the clock, by commands that act late.

    python examples/transform/follow_a_clock.py

The policy observes the state in which its command will act. It must also evaluate a reference r(t)
at that time, `info["afm"]["delay"]` steps ahead. A cart tracks a sine, three steps late from step
50 on; a ground robot drives behind a moving target, by turns of 30 steps two late and not.
"""

from collections import deque

import gymnasium
import numpy as np
import pandas as pd
import torch
from gymnasium.spaces import Box

from afm_rl import ActionFlowWrapper
from afm_rl.dynamics import dubins_step
from afm_rl.report.tables import markdown

DT = 0.1


class Cart:
    """A cart on a rail, position and speed, that tracks a sine."""

    start, reach = (0.0, 0.5), (2.0,)

    def late(self, step):
        return 3 * (step >= 50)

    def move(self, state, action):
        place, speed = state.unbind(-1)
        return torch.stack([place + DT * speed, speed + DT * action[..., 0]], -1)

    def reference(self, t):
        return np.sin(0.8 * t), 0.8 * np.cos(0.8 * t), -0.64 * np.sin(0.8 * t)

    def act(self, state, reference):
        (place, speed), (there, rate, push) = state, reference
        return np.array([push + 4.0 * (there - place) + 3.0 * (rate - speed)])

    def miss(self, state, reference):
        return abs(state[0] - reference[0])


class Rover:
    """A ground robot, position and heading, behind a target on an eight."""

    start, reach = (-1.0, 0.0, 0.8), (2.0, 2.0)

    def late(self, step):
        return 2 * (step // 30 % 2)

    def move(self, state, action):
        return dubins_step(state, action, DT)

    def reference(self, t):
        return 4.0 * np.sin(0.25 * t), 2.0 * np.sin(0.5 * t)

    def act(self, state, reference):
        x, y = np.subtract(reference, state[:2])
        turn = np.angle(np.exp(1j * (np.arctan2(y, x) - state[2])))
        return np.array([1.5 * np.hypot(x, y) * np.cos(turn), 3.0 * turn])

    def miss(self, state, reference):
        return np.hypot(*np.subtract(reference, state[:2]))


class Robot(gymnasium.Env):
    """A robot whose commands may act late."""

    def __init__(self, body, healthy=False):
        self.body, self.healthy = body, healthy
        reach = np.array(body.reach)
        self.action_space = Box(-reach, reach, dtype=np.float64)
        self.observation_space = Box(-np.inf, np.inf, (len(body.start),), np.float64)

    def reset(self, *, seed=None, options=None):
        self.state, self.step_count = np.array(self.body.start), 0
        self.sent = deque([np.zeros(self.action_space.shape)] * 9, maxlen=9)
        return self.state, {}

    def step(self, action):
        self.sent.append(np.clip(action, self.action_space.low, self.action_space.high))
        late = 0 if self.healthy else self.body.late(self.step_count)
        acts = torch.from_numpy(self.sent[-1 - late])
        self.state = self.body.move(torch.from_numpy(self.state), acts).numpy()
        self.step_count += 1
        return self.state, 0.0, False, False, {}


def follow(body, env, ahead=False, steps=240):
    """Return the mean distance (m) from the reference, which is taken at arrival if ``ahead``."""
    seen, info = env.reset(seed=0)
    missed = []
    for step in range(steps):
        delay = info["afm"]["delay"] if ahead else 0
        seen, _, _, _, info = env.step(body.act(seen, body.reference(DT * (step + delay))))
        missed.append(body.miss(env.unwrapped.state, body.reference(DT * (step + 1))))
    return np.mean(missed[60:])


def main():
    torch.set_num_threads(1)
    rows = {}
    for name, body in {"cart": Cart(), "ground robot": Rover()}.items():
        corrected = ActionFlowWrapper(Robot(body), body.move)
        rows[name] = {
            "healthy": follow(body, Robot(body, healthy=True)),
            "late, without AFM": follow(body, Robot(body)),
            "AFM, reference of now": follow(body, corrected),
            "AFM, reference at arrival": follow(body, corrected, ahead=True),
        }
    table = pd.DataFrame(rows).T.map("{:.3f}".format)
    print(markdown("distance (m)", table.rename_axis("").reset_index()))


if __name__ == "__main__":
    main()
