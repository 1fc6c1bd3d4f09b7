"""Train a policy with TorchRL's soft actor-critic on a healthy robot; then reverse its motor.

    python examples/torchrl/sac.py

The correction is in the environment all the time. The loss reads the planned action, whose
probability the policy knows, and needs no information about the correction.
"""

import argparse
import tempfile

import torch
from swing_up import make_env
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

NOTES = ["afm", "regime", ("next", "afm"), ("next", "regime")]  # a policy's loss reads none


def make_actor(env: EnvBase, units: int) -> ProbabilisticActor:
    """Return a policy with two hidden layers."""
    box = env.action_spec.space
    network = nn.Sequential(
        MLP(out_features=2 * len(box.low), num_cells=[units] * 2), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": box.low, "high": box.high},
        return_log_prob=True,
    )
    actor(env.reset())  # now its layers know their sizes
    return actor


class Learner:
    """Soft actor-critic: loss, averages of the critics, and optimiser."""

    def __init__(self, env: EnvBase, units: int) -> None:
        self.actor = make_actor(env, units)
        critic = ValueOperator(
            MLP(out_features=1, num_cells=[units] * 2), in_keys=["observation", "action"]
        )
        critic(env.fake_tensordict())
        self.loss = SACLoss(self.actor, critic, action_spec=env.action_spec)
        self.loss.make_value_estimator(gamma=0.98)
        self.averages = SoftUpdate(self.loss, tau=0.01)
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=1e-3)

    def update(self, buffer: TensorDictReplayBuffer, count: int) -> None:
        """Take so many steps on samples of a buffer."""
        for _ in range(count):
            losses = self.loss(buffer.sample())
            sum(losses[f"loss_{name}"] for name in ("actor", "qvalue", "alpha")).backward()
            self.optimiser.step()
            self.optimiser.zero_grad()
            self.averages.step()


def make_buffer(folder: str, size: int) -> TensorDictReplayBuffer:
    """Return a buffer on disk."""
    storage = LazyMemmapStorage(size, scratch_dir=folder, existsok=True)
    return TensorDictReplayBuffer(storage=storage, batch_size=128)


@set_exploration_type(ExplorationType.DETERMINISTIC)
def mean_reward(env: EnvBase, actor: ProbabilisticActor, steps: int) -> float:
    """Return the mean reward of a policy over episodes."""
    env.set_seed(0)
    with torch.no_grad():
        data = env.rollout(steps, actor, break_when_any_done=False)
    return float(data["next", "reward"].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=8000)
    parser.add_argument("--random", type=int, default=1000, help="frames before the policy acts")
    parser.add_argument("--units", type=int, default=64)
    parser.add_argument("--tested", type=int, default=2000, help="frames of each test")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = make_env(gain=1.0)
    env.set_seed(0)
    learner = Learner(env, asked.units)
    collector = Collector(
        env,
        learner.actor,
        frames_per_batch=200,
        total_frames=asked.frames,
        init_random_frames=asked.random,
        auto_register_policy_transforms=False,
    )
    with tempfile.TemporaryDirectory() as folder:
        buffer = make_buffer(folder, asked.frames)
        for batch in collector:
            buffer.extend(batch.exclude(*NOTES))
            learner.update(buffer, len(batch))
            reward = float(batch["next", "reward"].mean())
            print(f"{len(buffer)} frames: mean reward {reward:.2f}")
        collector.shutdown()
    for gain, corrected in ((1.0, True), (-1.0, False), (-1.0, True)):
        found = mean_reward(make_env(gain, corrected), learner.actor, asked.tested)
        how = "with AFM" if corrected else "without AFM"
        print(f"motor {gain:+.0f}, {how}: mean reward {found:.2f}")


if __name__ == "__main__":
    main()
