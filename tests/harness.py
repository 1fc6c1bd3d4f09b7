"""What the tests of several rooms make, drive and compare."""

import copy
import functools
import inspect
import runpy
import subprocess
import time

import pandas as pd
import pytest
import roma
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from tensordict import TensorDict

from afm_rl.cli.overrides import checked
from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss
from afm_rl.missions import build
from afm_rl.spaces.airframe import QuadrotorBody

WRENCH = torch.tensor([0.1, 2e-5, 2e-5, 5e-6], dtype=torch.float64)  # small, of a quadrotor

LOW, HIGH = BOX = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])  # of the ground robot
SMALL = {
    "planner.candidates": 8,
    "planner.elites": 2,
    "dynamics.members": 2,
    "dynamics.hidden": [8, 8],
    "dynamics.pretrain.samples": 256,
    "dynamics.pretrain.epochs": 1,
    "dynamics.pretrain.flights": 4,
    "dynamics.base.members": 2,
    "dynamics.base.hidden": [8, 8],
    "dynamics.base.pretrain.samples": 256,
    "dynamics.base.pretrain.epochs": 1,
    "corrector.width": 8,
    "corrector.train.iterations": 5,
    "robot.contexts": 2,
    "robot.data.rounds": [64, 64],
    "robot.data.fit.epochs": 1,
}


def refused(*rows, says="{}"):
    """Make a test of each row: a message of one line, with the words at its end.

    The arguments are the first ones of the function, the others are fixtures.
    """

    def decorate(call):
        signature = inspect.signature(call)
        given = [*list(signature.parameters)[: len(rows[0]) - 1], "words"]
        words = inspect.Parameter("words", inspect.Parameter.KEYWORD_ONLY)

        @functools.wraps(call)
        def test(*, words, **arguments):
            with pytest.raises(ConfigurationError, match=says.format(words)) as error:
                call(**arguments)
            assert "\n" not in str(error.value)

        test.__signature__ = signature.replace(parameters=[*signature.parameters.values(), words])
        return pytest.mark.parametrize(given, rows)(test)

    return decorate


def loss_by_row(model):
    """Return the loss of each transition."""
    loss = GaussianNLLLoss(model)
    loss.reduction = "none"
    return loss


def shrink(cfg, more=()):
    """Make the settings small that are there, in place."""
    for key, value in (SMALL | dict(more)).items():
        if OmegaConf.select(cfg, key) is not None:
            OmegaConf.update(cfg, key, value)
    return cfg


@functools.cache
def composed(*overrides):
    """Compose a configuration, each once, as it takes a tenth of a second; to be copied."""
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        return compose("config", list(overrides))


def agent_of(*overrides, trusted=()):
    """Build what settings ask for."""
    return build(copy.deepcopy(composed(*overrides)), trusted)


def agent_trusting(folder, *overrides, change=lambda cfg: cfg):
    """Build what a command asks for that trusts a package."""
    asked = [f"trust=[{folder}]", *overrides]
    with checked(asked) as names, initialize_config_module("afm_rl.conf", version_base="1.3"):
        return build(change(compose("config", asked)), names)


def situation(*batch, name, **memory):
    """Where robots are, where they shall go, and what a planner remembers, of these shapes."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*batch, *shape, generator=generator)

    td = TensorDict({"observation": draw(3), "goal": 3 * draw(2)}, batch)
    kept = {entry: 0.3 * draw(*shape) for entry, shape in memory.items()}
    return td.set(name, TensorDict(kept, batch))


def program_of(path):
    """Return what a program defines, beside others of its folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(path.parent))
        return runpy.run_path(str(path))


def track_of(path, points):
    """Write a track through points (m); return where it is."""
    path.write_text("x,y\n" + "".join(f"{x:.4f},{y:.4f}\n" for x, y in points))
    return str(path)


def level(*batch, dtype=torch.float32):
    """States ``(*batch, 13)`` of quadrotors that hover at the origin."""
    return torch.zeros(*batch, 13, dtype=dtype).index_fill(-1, torch.tensor(9), 1.0)


def transition(state, action, after=None, factor=-1.0):
    """A transition; without ``after`` that of the ground robot under a gain."""
    after = Dubins()(state, factor * action) if after is None else after
    td = TensorDict({"observation": state, "action": action}, state.shape[:-1])
    return td.set(("next", "observation"), after)


def until(holds):
    """Wait for something, and fail after two minutes."""
    end = time.monotonic() + 120
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def weights(model, index=...):
    """Return all parameters, or those of one mission, as one vector."""
    return torch.cat([parameter.detach()[index].flatten() for parameter in model.parameters()])


def grown_apart(model):
    """Perturb all parameters, so that members and missions differ."""
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter), alpha=0.1)
    return model


def same_weights(left, right):
    """Are all parameters and buffers equal to the bit?"""
    left, right = left.state_dict(), right.state_dict()
    return left.keys() == right.keys() and all(torch.equal(left[key], right[key]) for key in left)


def assert_same_tables(left, right, *without):
    """Compare tables bit for bit, but for the time that was spent."""
    left, right = (
        table.drop(columns=["seconds", *without], errors="ignore").reset_index(drop=True)
        for table in (left, right)
    )
    pd.testing.assert_frame_equal(left, right, check_exact=True)


def assert_same_results(left, right, *without):
    """Compare missions and steps bit for bit, but for the time that was spent."""
    assert_same_tables(left.missions, right.missions, *without)
    assert_same_tables(left.steps, right.steps, *without)


def files_of(folder):
    """Return the names and contents of all files in a folder, but for locks."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def commit(folder):
    """Commit all files of a folder, which becomes a repository."""
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b"]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "a"]):
        subprocess.run([*git, *arguments], cwd=folder, check=True)


def mutated(data, rng):
    """Return bytes of which some are changed, cut out, put in, or filled with ones."""
    found, place = bytearray(data), rng.randrange(len(data))
    if rng.random() < 0.3:  # what is where is often written at the end
        place = max(0, len(data) - rng.randint(1, 300))
    noise = rng.randbytes(rng.randint(1, 16))
    match rng.randrange(5):
        case 0:
            found[place : place + len(noise)] = noise
        case 1:
            del found[place:]
        case 2:
            del found[place : place + rng.randint(1, 64)]
        case 3:
            found[place:place] = noise
        case 4:
            found[place : place + 8] = b"\xff" * 8
    return bytes(found)


def flights(*batch, seed=0):
    """Return states and actions of quadrotors near hovering, in double precision."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*batch, 13, generator=generator, dtype=torch.float64)
    state[..., 6:10] = roma.quat_normalize(state[..., 6:10])
    action = torch.randn(*batch, 4, generator=generator, dtype=torch.float64) * WRENCH
    action[..., 0] += QuadrotorBody().hover_thrust
    return state, action
