r"""Train a policy as most people would: soft actor-critic, for any gymnasium task, on one core.

    python examples/policies/train_sac.py --id HalfCheetah-v5 --out cheetah.safetensors

Haarnoja et al. 2018, arXiv 1812.05905: two critics, temperature tuned to an entropy of -A, one
update per step, batch 256. A plain loop: one update takes 8 ms, with `torchrl.objectives.SACLoss`
and the same networks 17 ms. `--randomise` draws other actuators for every episode, the customary
remedy against changes. A run that was ended goes on from its last checkpoint, in the folder
beside the file. Stored is the mean action, for `afm_rl.planning.load_policy`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from afm_rl import FaultWrapper
from afm_rl.planning import StoredPolicy, load_policy, save_policy
from afm_rl.storage.files import write_whole

BATCH, CHECKPOINT, DISCOUNT, AVERAGING, RATE = 256, 20_000, 0.99, 0.005, 3e-4


class RandomActuators(FaultWrapper):
    """Other actuators in every episode: healthy, one reversed, all weak, one dead, or biased."""

    def __init__(self, env: gymnasium.Env, seed: int) -> None:
        super().__init__(env)
        self.random = np.random.default_rng(seed)

    def reset(self, **options):
        size = len(self.action_space.low)
        kind = self.random.choice(["healthy", "reversed", "weak", "dead", "biased"])
        if kind == "weak":
            fault = {f"gain_{k}": x for k, x in enumerate(self.random.uniform(0.3, 1.0, size))}
        elif kind == "biased":
            fault = {f"bias_{k}": x for k, x in enumerate(self.random.uniform(-0.3, 0.3, size))}
        else:
            gains = {"healthy": 1.0, "reversed": -1.0, "dead": 0.0}
            fault = {f"gain_{self.random.integers(size)}": gains[kind]}
        self.fail(fault)
        return super().reset(**options)


class Agent(nn.Module):
    """Actor, critics and their averages; ``update`` is one step of soft actor-critic."""

    def __init__(self, observations: int, actions: int, units: int) -> None:
        super().__init__()
        self.actor = network(observations, units, 2 * actions)
        self.critics = nn.ModuleList(network(observations + actions, 256, 1) for _ in range(2))
        self.averages = nn.ModuleList(network(observations + actions, 256, 1) for _ in range(2))
        self.averages.load_state_dict(self.critics.state_dict())
        self.averages.requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.zeros(()))
        self.entropy = -float(actions)
        trained = [value for value in self.parameters() if value.requires_grad]
        self.optimiser = torch.optim.Adam(trained, lr=RATE, fused=True)

    def sample(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return an action in the unit box ``(B, A)``, and its log probability ``(B, 1)``."""
        mean, log_scale = self.actor(observation).chunk(2, -1)
        log_scale, noise = log_scale.clamp(-10, 2), torch.randn_like(mean)
        raw = mean + noise * log_scale.exp()
        slope = 2 * (math.log(2) - raw - nn.functional.softplus(-2 * raw))  # log(1 - tanh^2)
        log_density = -0.5 * noise.square() - log_scale - 0.5 * math.log(2 * math.pi)
        return raw.tanh(), (log_density - slope).sum(-1, keepdim=True)

    def update(self, batch: Tensor, actions: int) -> None:
        """Learn from rows (observation, action, next observation, reward, goes on)."""
        size = (batch.shape[1] - actions - 2) // 2
        now, action, after, reward, goes_on = batch.split([size, actions, size, 1, 1], 1)
        temperature = self.log_temperature.exp().detach()
        with torch.no_grad():
            next_action, log_density = self.sample(after)
            value = lowest(self.averages, after, next_action) - temperature * log_density
            target = reward + DISCOUNT * goes_on * value
        self.critics.requires_grad_(True)
        seen = torch.cat([now, action], 1)
        sum((critic(seen) - target).square().mean() for critic in self.critics).backward()
        self.critics.requires_grad_(False)
        chosen, log_density = self.sample(now)
        loss = (temperature * log_density - lowest(self.critics, now, chosen)).mean()
        gap = (log_density.detach() + self.entropy).mean()
        (loss - self.log_temperature * gap).backward()
        self.optimiser.step()
        self.optimiser.zero_grad()
        torch._foreach_lerp_(
            list(self.averages.parameters()), [p.data for p in self.critics.parameters()], AVERAGING
        )


def network(inputs: int, units: int, outputs: int) -> nn.Sequential:
    first, second, last = (
        nn.Linear(inputs, units),
        nn.Linear(units, units),
        nn.Linear(units, outputs),
    )
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)


def lowest(critics: nn.ModuleList, observation: Tensor, action: Tensor) -> Tensor:
    seen = torch.cat([observation, action], 1)
    return torch.min(critics[0](seen), critics[1](seen))


class Run:
    """A training run, in a folder from which it goes on."""

    def __init__(self, args: argparse.Namespace) -> None:
        torch.manual_seed(args.seed)
        torch.set_num_threads(1)
        self.args, self.env = args, gymnasium.make(args.id)
        if args.randomise:
            self.env = RandomActuators(self.env, args.seed)
        self.observations = self.env.observation_space.shape[0]
        self.actions = self.env.action_space.shape[0]
        self.agent = Agent(self.observations, self.actions, args.units)
        self.rows = torch.zeros(args.steps, 2 * self.observations + self.actions + 2)
        self.step, self.spent = 0, 0.0
        self.folder = args.out.with_suffix(".run")
        if (self.folder / "state.json").is_file():
            self._resume()

    def _resume(self) -> None:
        state = json.loads((self.folder / "state.json").read_text())
        self.step, self.spent = state["step"], state["spent"]
        held = load_file(self.folder / f"{self.step}.safetensors")
        self.rows[: self.step] = held.pop("rows")
        moments = {key: held.pop(key) for key in list(held) if key.startswith("adam.")}
        self.agent.load_state_dict(held)
        adam = self.agent.optimiser.state_dict()
        for key, value in moments.items():
            _, index, name = key.split(".")
            adam["state"].setdefault(int(index), {})[name] = value
        self.agent.optimiser.load_state_dict(adam)
        torch.manual_seed(self.args.seed + self.step)

    def checkpoint(self) -> None:
        """Write all that is needed to go on; the description last."""
        adam = self.agent.optimiser.state_dict()["state"]
        moments = {f"adam.{i}.{name}": v for i, part in adam.items() for name, v in part.items()}
        held = {**self.agent.state_dict(), **moments, "rows": self.rows[: self.step]}
        write_whole(self.folder / f"{self.step}.safetensors", save(held))
        state = {"step": self.step, "spent": self.spent}
        write_whole(self.folder / "state.json", json.dumps(state).encode())
        for old in self.folder.glob("*.safetensors"):
            if old.stem != str(self.step):
                old.unlink()

    def train(self) -> None:
        """Play and learn; print the return of every tenth episode."""
        low, high = self.env.action_space.low, self.env.action_space.high
        observation, _ = self.env.reset(seed=self.args.seed + self.step)
        total, episodes, start = 0.0, 0, time.process_time() - self.spent
        while self.step < self.args.steps:
            if self.step < self.args.first:
                unit = torch.rand(self.actions) * 2 - 1
            else:
                with torch.no_grad():
                    seen = torch.as_tensor(observation, dtype=torch.float32)
                    unit = self.agent.sample(seen)[0]
            action = (low + (high - low) * (unit.numpy() + 1) / 2).astype(low.dtype)
            after, reward, terminated, truncated, _ = self.env.step(action)
            numbers = [observation, unit.numpy(), after, [reward, not terminated]]
            self.rows[self.step] = torch.from_numpy(np.concatenate(numbers))
            observation, total, self.step = after, total + float(reward), self.step + 1
            if terminated or truncated:
                if episodes % 10 == 0:
                    used = (time.process_time() - start) / 60
                    print(f"{self.step} steps, {used:.1f} min: return {total:.0f}", flush=True)
                observation, _ = self.env.reset()
                total, episodes = 0.0, episodes + 1
            if self.step >= self.args.first and self.step % self.args.every == 0:
                picked = torch.randint(self.step, (BATCH,))
                self.agent.update(self.rows[picked], self.actions)
            if self.step % CHECKPOINT == 0 and self.step < self.args.steps:
                self.spent = time.process_time() - start
                self.checkpoint()
                self.store()
        self.store()

    def store(self) -> None:
        """Write the mean action of the actor, with its return over five healthy episodes."""
        layers = [(part.weight, part.bias) for part in self.agent.actor if hasattr(part, "weight")]
        weight, bias = layers[-1]
        layers[-1] = weight[: self.actions], bias[: self.actions]
        space, args = self.env.action_space, self.args
        low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
        about = {
            "id": args.id,
            "seed": args.seed,
            "steps": self.step,
            "randomised": args.randomise,
        }
        policy = StoredPolicy(layers, low, high)
        save_policy(args.out, policy, about)
        found = returns(args.id, args.out, episodes=5)
        save_policy(args.out, policy, {**about, "return": round(float(found.mean()), 2)})
        print(f"{args.out}: return {found.mean():.1f} +- {found.std():.1f}", flush=True)


def returns(task: str, file: Path, episodes: int) -> np.ndarray:
    """Return the returns of a stored policy in the healthy task."""
    env, (policy, _) = gymnasium.make(task), load_policy(file)
    found = np.zeros(episodes)
    for episode in range(episodes):
        observation, _ = env.reset(seed=1000 + episode)
        over = False
        while not over:
            action = policy(torch.as_tensor(observation, dtype=torch.float32)).numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            found[episode] += float(reward)
            over = terminated or truncated
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--id", default="HalfCheetah-v5", help="a task of gymnasium")
    parser.add_argument("--steps", type=int, default=120_000)
    parser.add_argument("--first", type=int, default=5000, help="steps of random actions")
    parser.add_argument("--every", type=int, default=1, help="steps per update")
    parser.add_argument("--units", type=int, default=128, help="width of the actor")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--randomise", action="store_true", help="other actuators per episode")
    parser.add_argument("--out", type=Path, required=True, help="where the policy goes")
    Run(parser.parse_args()).train()


if __name__ == "__main__":
    main()
