"""PPO for continuous actions in one file, in the style of CleanRL, with Gymnasium, NumPy and PyTorch only.

python examples/outside_agent/ppo.py --env-id plab:plab/Move-v1 --total-steps 20000 --policy move.pt

Two lines are specific to plab: the import of ``record``, and its call. They record the agent's best plan
within each budget. The final deterministic policy is saved as TorchScript, for the track of policies.
"""

import argparse
import json

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from plab.submissions import record


def parse_args():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="plab:plab/Move-v1", help="id of the environment")
    parser.add_argument("--env-kwargs", type=json.loads, default={}, help="its keywords, as JSON")
    parser.add_argument("--recordings", default="recordings", help="folder of the recording")
    parser.add_argument("--policy", default="policy.pt", help="file of the trained policy, TorchScript")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=20_000, help="environment steps of the training")
    parser.add_argument("--episodes", type=int, default=4, help="episodes between two updates")
    parser.add_argument("--epochs", type=int, default=10, help="passes over them in an update")
    parser.add_argument("--minibatches", type=int, default=4)
    parser.add_argument("--learning-rate", type=float, default=3e-4)
    parser.add_argument("--gamma", type=float, default=0.99, help="discount")
    parser.add_argument("--gae-lambda", type=float, default=0.95)
    parser.add_argument("--clip", type=float, default=0.2, help="clipping of the probability ratio")
    parser.add_argument("--value-weight", type=float, default=0.5)
    parser.add_argument("--max-grad-norm", type=float, default=0.5)
    parser.add_argument("--std", type=float, default=0.5, help="standard deviation of the first actions")
    return parser.parse_args()


def mlp(inputs, outputs, last_gain):
    layers = []
    for n_in, n_out, gain in ((inputs, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, last_gain)):
        layer = nn.Linear(n_in, n_out)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Scale(nn.Module):
    """Normalisation of observations to mean 0 and variance 1, over all observations so far."""

    def __init__(self, entries):
        super().__init__()
        self.register_buffer("mean", torch.zeros(entries))
        self.register_buffer("var", torch.ones(entries))
        self.register_buffer("count", torch.tensor(1e-4))

    def update(self, x):
        total = self.count + len(x)
        delta = x.mean(0) - self.mean
        spread = self.var * self.count + x.var(0, unbiased=False) * len(x)
        self.var.copy_((spread + delta**2 * self.count * len(x) / total) / total)
        self.mean.add_(delta * len(x) / total)
        self.count.copy_(total)

    def forward(self, x):
        return ((x - self.mean) / torch.sqrt(self.var + 1e-8)).clamp(-10.0, 10.0)


def advantages_of(rewards, values, gamma, lam):
    """Generalised advantage estimates of one episode; it ends by truncation, so the last value is
    included."""
    deltas = rewards + gamma * values[1:] - values[:-1]
    out, running = torch.zeros_like(deltas), 0.0
    for t in reversed(range(len(deltas))):
        running = deltas[t] + gamma * lam * running
        out[t] = running
    return out


def main():
    args = parse_args()
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)

    env = gymnasium.make(args.env_id, **args.env_kwargs)
    env = record(env, args.recordings)
    entries, components = env.observation_space.shape[0], env.action_space.shape[0]

    scale = Scale(entries)
    actor, critic = mlp(entries, components, 0.01), mlp(entries, 1, 1.0)
    log_std = nn.Parameter(torch.full((components,), float(np.log(args.std))))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, lr=args.learning_rate, eps=1e-5)

    def dist(x):
        return Normal(actor(x), log_std.exp())

    steps, best = 0, 0.0
    while steps < args.total_steps:
        batch = []
        for _ in range(args.episodes):
            observation, _ = env.reset(seed=args.seed)
            seen, taken, rewards, over = [observation], [], [], False
            while not over:
                with torch.no_grad():
                    action = dist(scale(torch.from_numpy(observation)[None])).sample()[0]
                observation, reward, terminated, truncated, info = env.step(action.numpy().clip(-1.0, 1.0))
                seen.append(observation)
                taken.append(action)
                rewards.append(reward)
                over = terminated or truncated
                steps += 1
            best = max(best, info["score"])
            batch.append(
                (torch.from_numpy(np.stack(seen)), torch.stack(taken), torch.tensor(rewards).float())
            )

        with torch.no_grad():
            old = []
            for seen, taken, rewards in batch:
                x, values = scale(seen), critic(scale(seen))[:, 0]
                advantages = advantages_of(rewards / 100.0, values, args.gamma, args.gae_lambda)
                logp = dist(x[:-1]).log_prob(taken).sum(1)
                old.append((x[:-1], taken, logp, advantages, advantages + values[:-1]))
            x, taken, logp, advantages, returns = (torch.cat(part) for part in zip(*old, strict=True))
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

        for _ in range(args.epochs):
            for rows in np.array_split(rng.permutation(len(x)), args.minibatches):
                new = dist(x[rows])
                ratio = (new.log_prob(taken[rows]).sum(1) - logp[rows]).exp()
                clipped = ratio.clamp(1.0 - args.clip, 1.0 + args.clip)
                gain = torch.min(ratio * advantages[rows], clipped * advantages[rows]).mean()
                error = (critic(x[rows])[:, 0] - returns[rows]).square().mean()
                optimizer.zero_grad()
                (args.value_weight * error - gain).backward()
                nn.utils.clip_grad_norm_(parameters, args.max_grad_norm)
                optimizer.step()

        # After the update: within one the same observation has to mean the same.
        scale.update(torch.cat([seen for seen, _, _ in batch]))
        reward = np.mean([float(rewards.sum()) for _, _, rewards in batch])
        print(f"steps {steps}, mean reward of an episode {reward:.2f}, best score {best:.4f}", flush=True)

    env.close()
    policy = nn.Sequential(scale, actor, nn.Hardtanh()).eval()
    torch.jit.trace(policy, torch.zeros(1, entries)).save(args.policy)


if __name__ == "__main__":
    main()
