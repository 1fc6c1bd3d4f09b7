"""A puck that two forces push, as an environment of gymnasium."""

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode


def push(state, action):
    return torch.cat([state[..., :2] + 0.1 * state[..., 2:], state[..., 2:] + 0.1 * action], -1)


class Puck(gymnasium.Env):
    """Two forces push a puck; ``gain`` is hidden from everybody."""

    def __init__(self, dtype=np.float64, gain=1.0, ends=None, nested=False):
        self.dtype, self.gain, self.ends, self.nested = dtype, np.asarray(gain), ends, nested
        vector = Box(-np.inf, np.inf, (4,), dtype)
        self.observation_space = Dict({"puck": vector}) if nested else vector
        self.action_space = Box(-1, 1, (2,), dtype)

    def _seen(self):
        seen = self.state.astype(self.dtype)
        return {"puck": seen} if self.nested else seen

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.normal(size=4), 0
        return self._seen(), {"mine": 1}

    def step(self, action):
        assert self.action_space.contains(action)
        speed = self.state[2:] + 0.1 * self.gain * action
        self.state = np.concatenate([self.state[:2] + 0.1 * self.state[2:], speed])
        self.steps += 1
        return self._seen(), float(action.sum()), self.steps == self.ends, False, {"mine": 2}


def alone(env, plans, mode, seed=None):
    """Play one environment as a vector does; yield steps, without those that only reset."""
    env.reset(seed=seed)
    over = False
    for step, plan in enumerate(plans):
        if over and mode is AutoresetMode.NEXT_STEP:  # this step only resets
            env.reset()
            over = False
            continue
        *_, over, _, info = env.step(plan)
        yield step, info
        if over and mode is not AutoresetMode.NEXT_STEP:
            env.reset()


def play(env, steps, seed=0, hold=0.0):
    """Act at random; ``hold`` keeps a puck near its place."""
    seen, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    told = []
    for _ in range(steps):
        planned = env.action_space.sample() - hold * (seen[:2] + seen[2:] if hold else 0.0)
        told.append(env.step(planned.clip(-1, 1)))
        seen = told[-1][0]
    return told
