"""Each shell around pucks whose actuators are reversed: transform, policy, controller, wrappers.

``shell(plans, dtype, gain, ends, switch, **settings)`` yields what is executed for each plan;
episodes have ``ends`` steps, ``switch`` says from which step on actions are corrected,
and ``settings`` are those of the loop.
"""

import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from puck import Puck, push
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper
from afm_rl.dynamics import KnownDynamics
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform
from afm_rl.transforms.controller import Controller

EPISODE = 6
STAY = {}  # whether actions are corrected from a step on, by step: it stays as it is
BOX = -torch.ones(2), torch.ones(2)
MODEL = KnownDynamics(push, Manifold(4), 2)


def starts(dtype):
    generator = torch.Generator().manual_seed(0)
    while True:
        yield torch.randn(4, generator=generator).to(dtype)


def pucks(gain, transform):
    """An environment of any batch shape."""
    actual = KnownDynamics(lambda s, a: push(s, gain * a), Manifold(4), 2)
    cost = KnownReward(lambda s, a, n: -n.square().sum(-1))
    return TransformedEnv(PlanningEnv(actual, cost, *BOX), transform)


def transform(plans, dtype, gain=-1.0, ends=EPISODE, switch=STAY, **settings):
    env, start = pucks(gain, ActionFlowTransform(MODEL, **settings)), starts(dtype)
    for k, plan in enumerate(plans):
        if k % ends == 0:
            td = env.reset(TensorDict({"observation": next(start)}))
        env.transform.enabled = switch.get(k, env.transform.enabled)
        td = step_mdp(env.step(td.set("action", plan)))
        yield td["afm", "executed_action"]


def policy(plans, dtype, gain=-1.0, ends=EPISODE, switch=STAY, **settings):
    corrected, start = ActionFlowPolicy(MODEL, Bounded(*BOX), **settings), starts(dtype)
    primer, td = corrected.make_tensordict_primer(), TensorDict()
    for k, plan in enumerate(plans):
        if k % ends == 0:
            td, state = primer(td), next(start)
        corrected.enabled = switch.get(k, corrected.enabled)
        td = corrected(td.update({"observation": state, "action": plan}))
        executed, td = td["action"], step_mdp(td)
        state = push(state.float(), gain * executed.float()).to(dtype)
        yield executed


def controller(
    plans, dtype, gain=-1.0, ends=EPISODE, switch=STAY, keep_memory_on_reset=False, **settings
):
    corrected = ActionFlowPolicy(
        MODEL, Bounded(*BOX), keep_memory_on_reset=keep_memory_on_reset, **settings
    )
    pure, start = Controller(None, corrected), starts(dtype)
    memory = pure.empty()
    for k, plan in enumerate(plans):
        if k % ends == 0:
            state = next(start)
            memory = memory if keep_memory_on_reset else pure.empty()
            memory["mode"] = -memory["mode"]
        if k in switch:
            memory["mode"] = torch.tensor([1.0 if switch[k] else 2.0])
        memory, executed = pure(memory, state, plan)
        state = push(state.float(), gain * executed.float()).to(dtype)
        yield executed


def numpy_of(dtype):
    return torch.zeros((), dtype=dtype).numpy().dtype


def wrapper(plans, dtype, gain=-1.0, ends=EPISODE, switch=STAY, **settings):
    env = ActionFlowWrapper(Puck(numpy_of(dtype), gain, ends), push, **settings)
    env.reset(seed=0)
    for k, plan in enumerate(plans):
        env.enabled = switch.get(k, env.enabled)
        *_, over, _, info = env.step(plan)
        if over:
            env.reset()
        yield torch.as_tensor(info["afm"]["executed_action"])


def vector(mode):
    def run(plans, dtype, gain=-1.0, ends=EPISODE, switch=STAY, **settings):
        makers = [lambda: Puck(numpy_of(dtype), gain, ends)] * 2
        env = SyncVectorEnv(makers, autoreset_mode=mode)
        env = ActionFlowVectorWrapper(env, push, **settings)
        env.reset(seed=0)
        for k, plan in enumerate(plans):
            env.enabled = switch.get(k, env.enabled)
            _, _, over, _, info = env.step(torch.stack([plan, plan]))
            if mode is AutoresetMode.DISABLED and over.any():
                env.reset(options={"reset_mask": over})
            executed = torch.as_tensor(info["afm"]["executed_action"][0])
            yield (
                executed if info["_afm"][0] else gain * plan.detach()
            )  # of a step that only resets

    return run


SHELLS = {f.__name__: f for f in (transform, policy, controller, wrapper)}
SHELLS |= {mode.value: vector(mode) for mode in AutoresetMode}
TIERS = {"transform": [], "wrapper": []}  # in `make test`
TIERS |= dict.fromkeys(("policy", "controller", "SameStep"), pytest.mark.check)


def by_tier(names):
    """Return names of shells as parameters; `make check` tries one kind of vector."""
    return [pytest.param(name, marks=TIERS.get(name, pytest.mark.slow)) for name in names]


def plans_of(count):
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
