"""Interrupt soft actor-critic, and resume it from TorchRL's checkpoint with the same result.

    python examples/torchrl/resume.py

It trains twice: without interruption, and with an interruption after which all objects are made
again. Both end with the same weights, bit for bit. The checkpoint is a folder of numbers and JSON:
nothing in it is executed.
"""

import argparse
import tempfile
from pathlib import Path

import torch
from sac import NOTES, Learner, make_buffer
from swing_up import make_env
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint, GlobalRNGState


def train(folder: Path, episodes: int, stop: int, steps: int, units: int) -> TensorDict:
    """Return the weights after ``stop`` of some ``episodes``, from the state in a folder."""
    torch.manual_seed(0)
    env = make_env()
    learner, progress = Learner(env, units), {"episode": 0}  # makes a first reset
    buffer = make_buffer(str(folder / "buffer"), episodes * steps)
    checkpoint = Checkpoint(
        env=env,
        loss=learner.loss,
        optimiser=learner.optimiser,
        buffer=buffer,
        progress=progress,
        random=GlobalRNGState(),
    )
    if Checkpoint.is_checkpoint(folder / "checkpoint"):
        checkpoint.load(folder / "checkpoint")
        print(f"continues with episode {progress['episode']}, {len(buffer)} transitions remembered")
    while progress["episode"] < stop:
        env.set_seed(progress["episode"])  # the simulator is where it was: at its beginning
        with torch.no_grad():
            buffer.extend(env.rollout(steps, learner.actor).exclude(*NOTES))
        learner.update(buffer, steps)
        progress["episode"] += 1
        checkpoint.save(folder / "checkpoint")
    return TensorDict.from_module(learner.loss).data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--steps", type=int, default=200, help="of an episode")
    parser.add_argument("--units", type=int, default=64)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    size = asked.steps, asked.units
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        whole = train(Path(first), asked.episodes, asked.episodes, *size)
        train(Path(second), asked.episodes, asked.episodes // 2, *size)
        resumed = train(Path(second), asked.episodes, asked.episodes, *size)
    print(f"the same weights: {bool((whole == resumed).all())}")


if __name__ == "__main__":
    main()
