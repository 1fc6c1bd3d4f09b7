"""Train a policy with TorchRL's PPO on reversed robots in worker processes.

    python examples/torchrl/ppo.py

PPO compares the probability of an action with its probability at the time of the choice. Both are
those of the planned action, which is always under ``"action"``.
"""

import argparse

import torch
from sac import NOTES, make_actor, mean_reward
from swing_up import make_env
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import ParallelEnv
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

SAMPLES = 16  # of a batch, an epoch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, default=50)
    parser.add_argument("--frames", type=int, default=2000, help="of a batch")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--tested", type=int, default=2000, help="frames of each test")
    parser.add_argument("--units", type=int, default=64)
    parser.add_argument("--start", default="spawn", help="how processes start: spawn or fork")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = make_env()
    actor = make_actor(env, asked.units)
    critic = ValueOperator(MLP(out_features=1, num_cells=[asked.units] * 2), ["observation"])
    critic(env.reset())
    advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(asked.frames),
        sampler=SamplerWithoutReplacement(),
        batch_size=asked.frames // SAMPLES,
    )
    env = ParallelEnv(asked.robots, make_env, mp_start_method=asked.start)
    env.set_seed(0)
    collector = Collector(
        env,
        actor,
        frames_per_batch=asked.frames,
        total_frames=asked.frames * asked.batches,
        auto_register_policy_transforms=False,
    )
    for count, batch in enumerate(collector):
        batch = batch.exclude(*NOTES)
        for _ in range(asked.epochs):
            with torch.no_grad():
                advantage(batch)
            buffer.extend(batch.reshape(-1))
            for _ in range(SAMPLES):
                losses = loss(buffer.sample())
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
                optimiser.zero_grad()
        print(f"batch {count}: mean reward {batch['next', 'reward'].mean():.2f}")
    collector.shutdown()
    for corrected in (True, False):
        found = mean_reward(make_env(corrected=corrected), actor, asked.tested)
        print(f"{'with AFM' if corrected else 'without AFM'}: mean reward {found:.2f}")


if __name__ == "__main__":
    main()
