"""COIL and PPO whole in one file, which needs PyTorch, NumPy and Gymnasium only.

COIL (Contextual Online Imitation Learning): the action that a guide would take is one more
observation of the agent. Everything else is PPO, so `--method ppo` differs by one line.

    python coil_single_file.py --env Pendulum-v1 --guide coil_single_file:swing_up --frames 200000
    python coil_single_file.py --env CartPole-v1 --method ppo

A guide is a function of the observation that returns an action of the env. Copy what you need;
`tests/examples` holds the updates of this file equal to those of the library.
"""

import argparse
import importlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Normal

EDGE = 1 - torch.finfo(torch.float32).resolution  # largest squashed action that can be inverted


@dataclass
class Batch:
    """Steps of B envs, [B, T, ...] each."""

    seen: Tensor  # what the agent observes, with the advice
    action: Tensor  # from -1 to 1, or the number of a choice
    log_prob: Tensor  # of the action
    reward: Tensor  # after the step
    terminated: Tensor  # whether the episode ended in the step
    done: Tensor  # whether it ended or was cut off
    after: Tensor  # what the agent would observe next


class Envs:
    """Envs side by side, whose observations end with the advice of a guide.

    Args:
        id: of Gymnasium.
        count: B, the number of envs.
        guide: returns an action for an observation; None: no advice, which is plain PPO.
        seed: of the first episode of the first env.
    """

    def __init__(self, id: str, count: int, guide: Callable | None, seed: int) -> None:
        self.envs, self.guide = [gymnasium.make(id) for _ in range(count)], guide
        space = self.envs[0].action_space
        self.choices = int(space.n) if isinstance(space, gymnasium.spaces.Discrete) else 0
        if not self.choices:
            self.centre, self.unit = (space.high + space.low) / 2, (space.high - space.low) / 2
        self.actions = self.choices or space.shape[0]
        self.now = [self.observe(env.reset(seed=seed + i)[0]) for i, env in enumerate(self.envs)]
        self.size = len(self.now[0])
        self.sums, self.returns = [0.0] * count, list[float]()

    def observe(self, observation: np.ndarray) -> np.ndarray:
        """Return an observation followed by the advice: from -1 to 1, or one-hot."""
        if self.guide is None:
            return observation.astype(np.float32)
        given = self.guide(observation)
        if self.choices:
            advice = np.eye(self.choices)[int(given)]
        else:
            advice = np.clip((given - self.centre) / self.unit, -1, 1)
        return np.concatenate([observation, advice]).astype(np.float32)

    def step(self, actions: Tensor) -> list[tuple]:
        """Do a step in each env; return reward, terminated, done and the observation after it."""
        steps = []
        for index, (env, action) in enumerate(zip(self.envs, actions.numpy(), strict=True)):
            own = int(action) if self.choices else self.centre + self.unit * action
            observation, reward, terminated, truncated, _ = env.step(own)
            self.sums[index] += float(reward)
            after = self.now[index] = self.observe(observation)
            if terminated or truncated:
                self.returns.append(self.sums[index])
                self.sums[index] = 0.0
                self.now[index] = self.observe(env.reset()[0])
            steps.append((float(reward), terminated, terminated or truncated, after))
        return steps


def layers(inputs: int, outputs: int, gain: float, hidden: int = 64) -> nn.Sequential:
    """Return a network with two hidden layers and orthogonal weights."""
    sizes = [(inputs, hidden, 2**0.5), (hidden, hidden, 2**0.5), (hidden, outputs, gain)]
    parts: list[nn.Module] = []
    for fan_in, fan_out, scale in sizes:
        layer = nn.Linear(fan_in, fan_out)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        parts += [layer, nn.Tanh()]
    return nn.Sequential(*parts[:-1])


class Agent(nn.Module):
    """Policy and critic. Numbers are squashed by tanh; of choices one is drawn.

    Args:
        size: of what is observed.
        actions: number of numbers of an action, or of choices.
        choices: whether the action is a choice.
    """

    def __init__(self, size: int, actions: int, choices: bool) -> None:
        super().__init__()
        self.actor, self.critic = layers(size, actions, 0.01), layers(size, 1, 1.0)
        self.choices = choices
        self.log_scale = nn.Parameter(torch.full((0 if choices else actions,), math.log(0.5)))

    def act(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return sampled actions and their logarithmic probabilities."""
        if self.choices:
            action = Categorical(logits=self.actor(seen)).sample()
        else:
            action = Normal(self.actor(seen), self.log_scale.exp()).sample().tanh()
        return action, self.log_prob(seen, action)

    def log_prob(self, seen: Tensor, action: Tensor) -> Tensor:
        """Return the logarithmic probabilities of actions, [N]."""
        if self.choices:
            return Categorical(logits=self.actor(seen)).log_prob(action)
        raw = action.clamp(-EDGE, EDGE).atanh()
        stretch = 2 * (math.log(2) - raw - nn.functional.softplus(-2 * raw))
        return (Normal(self.actor(seen), self.log_scale.exp()).log_prob(raw) - stretch).sum(-1)


@torch.no_grad()
def collect(envs: Envs, agent: Agent, steps: int) -> Batch:
    """Return the next steps of all envs."""
    rows = []
    for _ in range(steps):
        seen = torch.from_numpy(np.stack(envs.now))
        action, log_prob = agent.act(seen)
        reward, terminated, done, after = zip(*envs.step(action), strict=True)
        ends = torch.tensor([terminated, done])
        rows.append(
            (seen, action, log_prob, torch.tensor(reward), *ends, torch.tensor(np.stack(after)))
        )
    return Batch(*(torch.stack(column, 1) for column in zip(*rows, strict=True)))


@torch.no_grad()
def advantages(agent: Agent, batch: Batch, gamma: float, lam: float) -> tuple[Tensor, Tensor]:
    """Return generalised advantages and the targets of the critic, [B, T] each."""
    value = agent.critic(batch.seen).squeeze(-1)
    following = torch.cat([value[:, 1:], agent.critic(batch.after[:, -1:]).squeeze(-1)], 1)
    cut = batch.done & ~batch.terminated  # the state goes on, but not in this batch
    following[cut] = agent.critic(batch.after[cut]).squeeze(-1)
    errors = batch.reward + gamma * following * ~batch.terminated - value
    advantage, later = torch.zeros_like(value), torch.zeros(len(value))
    for t in reversed(range(value.shape[1])):
        later = errors[:, t] + gamma * lam * ~batch.done[:, t] * later
        advantage[:, t] = later
    return advantage, advantage + value


class PPO:
    """Proximal policy optimisation: clipped steps on minibatches of a batch."""

    def __init__(
        self,
        agent: Agent,
        minibatches: int = 16,  # in each pass over a batch
        epochs: int = 5,  # passes over a batch
        learning_rate: float = 1e-3,  # at the start; it falls to 0 over the run
        gamma: float = 0.99,  # discount
        lam: float = 0.95,  # lambda of the advantages
        clip: float = 0.2,  # largest change of a probability ratio that is rewarded
        seed: int = 0,  # of the order of the steps
    ) -> None:
        self.agent, self.minibatches, self.epochs = agent, minibatches, epochs
        self.learning_rate, self.gamma, self.lam = learning_rate, gamma, lam
        self.bounds = math.log1p(-clip), math.log1p(clip)
        self.adam = torch.optim.Adam(agent.parameters(), eps=1e-5)
        self.orders = torch.Generator().manual_seed(seed)

    def update(self, batch: Batch, progress: float) -> None:
        """Learn from a batch; `progress` is the finished share of the run."""
        self.adam.param_groups[0]["lr"] = self.learning_rate * (1 - progress)
        advantage, target = advantages(self.agent, batch, self.gamma, self.lam)
        columns = [batch.seen, batch.action, batch.log_prob, advantage, target]
        rows = [column.flatten(0, 1) for column in columns]
        for index in self.draw(len(rows[0])):
            loss = self.loss(*(row[index] for row in rows))
            self.adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.agent.parameters(), 0.5)
            self.adam.step()

    def draw(self, count: int) -> Iterator[Tensor]:
        """Yield the rows of each minibatch."""
        size = count // self.minibatches
        for _ in range(self.epochs):
            order = torch.randperm(count, generator=self.orders)
            yield from order[: size * self.minibatches].split(size)

    def loss(self, seen: Tensor, action: Tensor, old: Tensor, gain: Tensor, target: Tensor):
        """Return the loss of a minibatch: the clipped objective and the error of the critic."""
        gain = (gain - gain.mean()) / gain.std().clamp_min(1e-4)
        log_ratio = self.agent.log_prob(seen, action) - old
        objective = torch.minimum(
            log_ratio.exp() * gain, log_ratio.clamp(*self.bounds).exp() * gain
        )
        error = (self.agent.critic(seen).squeeze(-1) - target).square().mean()
        return 0.5 * error - objective.mean()


def swing_up(observation: np.ndarray) -> np.ndarray:
    """Return the torque that pumps energy into Pendulum-v1, and holds it upright: a guide."""
    cos, sin, speed = observation
    if cos > 0.9:
        return np.array([-12 * sin - 3 * speed]).clip(-2, 2)
    return np.array([2.0 * np.sign(speed + 1e-9)])


def main(arguments: list[str] | None = None) -> list[float]:
    """Train, print the mean return of the last episodes, and return the returns of all."""
    parser = argparse.ArgumentParser(description="Train COIL or PPO in a Gymnasium env.")
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--method", choices=["coil", "ppo"], default="coil")
    parser.add_argument("--guide", default="coil_single_file:swing_up", help="MODULE:FUNCTION")
    for name, value in {"frames": 200_000, "envs": 8, "steps": 256, "seed": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    given = parser.parse_args(arguments)
    module, _, function = given.guide.partition(":")
    guide = getattr(importlib.import_module(module), function) if given.method == "coil" else None
    torch.manual_seed(given.seed)
    envs = Envs(given.env, given.envs, guide, given.seed)
    agent = Agent(envs.size, envs.actions, bool(envs.choices))
    ppo, start = PPO(agent, seed=given.seed), time.monotonic()
    updates = max(1, given.frames // (given.envs * given.steps))
    for number in range(updates):
        ppo.update(collect(envs, agent, given.steps), number / updates)
        frames = (number + 1) * given.envs * given.steps
        mean = np.mean(envs.returns[-20:]) if envs.returns else math.nan
        print(f"{frames} frames, return {mean:.1f}, {frames / (time.monotonic() - start):.0f}/s")
    return envs.returns


if __name__ == "__main__":
    main()
