"""PPO written by hand, in plain PyTorch: the yardstick for what our training costs beyond the mathematics.

It does what `coil_rl.learners.PPO` does with a `Rollout`, with the same numbers, but owns its loop from top to bottom,
as CleanRL does: the env's step is called directly, and no transform, actor, loss or estimator lies between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase

from coil_rl.schedules import Schedule, schedule


class Batch(NamedTuple):
    """T steps of B cars: [T, B, n] where a number of entries is given, else [T, B]."""

    observation: Tensor  # [T, B, D], the advice included
    raw: Tensor  # [T, B, A], the action before it is squashed
    log_prob: Tensor
    reward: Tensor
    terminated: Tensor
    done: Tensor
    after: Tensor  # [T, B, D], what a step led to, before any reset


class PlainPPO:
    """Networks, rollout and update in one.

    Args:
        env: a batched env whose action is bounded by -1 and 1.
        guide: its action is appended to what the agent observes; None for plain PPO.
        steps: T.
        hidden: as for `coil_rl.learners.PPO`, like all that follow.
        action_scale: standard deviation at the start.
        learning_rate: a number or a schedule.
        gamma: discount.
        gae_lambda: lambda.
        clip: of the ratio.
        epochs: passes over each batch.
        minibatches: parts of each pass.
        entropy: must be 0.
        critic: weight of the critic's loss.
        max_grad_norm: largest norm of the gradient.
        seed: of the order of minibatches.
    """

    def __init__(
        self,
        env: EnvBase,
        guide: TensorDictModuleBase | None,
        steps: int,
        *,
        hidden: Sequence[int] = (64, 64),
        action_scale: float = 0.5,
        learning_rate: float | Schedule = 3e-4,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        epochs: int = 10,
        minibatches: int = 16,
        entropy: float = 0.0,
        critic: float = 0.5,
        max_grad_norm: float = 0.5,
        seed: int = 0,
    ) -> None:
        if entropy:
            raise ValueError(f"entropy={entropy} must be 0: the hand-written loop has no entropy bonus")
        self.env, self.guide, self.steps = env, guide, steps
        self.learning_rate = schedule(learning_rate)
        self.gamma, self.gae_lambda, self.clip = gamma, gae_lambda, clip
        self.epochs, self.minibatches = epochs, minibatches
        self.critic_weight, self.max_grad_norm = critic, max_grad_norm
        self.keys = ["observation", *(guide.in_keys if guide is not None else [])]
        with torch.no_grad():
            self.observation = self.look(env._reset(None))
        size = env.action_spec.shape[-1]
        self.actor = network(self.observation.shape[-1], hidden, size, gain=0.01).to(env.device)
        self.critic = network(self.observation.shape[-1], hidden, 1, gain=1.0).to(env.device)
        self.log_scale = nn.Parameter(torch.full((size,), math.log(action_scale), device=env.device))
        self.parameters = [*self.actor.parameters(), self.log_scale, *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate(0), eps=1e-5, fused=True)
        self.generator = torch.Generator().manual_seed(seed)

    def look(self, state: TensorDictBase) -> Tensor:
        """[B, D]: what the agent observes of what the env wrote."""
        if self.guide is None:
            seen: Tensor = state["observation"]
            return seen
        return torch.cat([state["observation"], self.guide(state.select(*self.guide.in_keys))["action"]], -1)

    @torch.no_grad()
    def collect(self) -> Batch:
        """Drive for T steps, sampling actions and putting cars that are done back on a start."""
        rows = []
        for _ in range(self.steps):
            observation = self.observation
            mean = self.actor(observation)
            raw = mean + self.log_scale.exp() * torch.randn_like(mean)
            state = self.env._step(TensorDict({"action": raw.tanh()}, self.env.batch_size))
            self.observation = after = self.look(state)
            reward, terminated, done = (state[key].squeeze(-1) for key in ("reward", "terminated", "done"))
            if done.any():
                fresh = self.env._reset(TensorDict({"_reset": done}, self.env.batch_size))
                self.observation = after.clone()
                self.observation[done] = self.look(fresh.select(*self.keys)[done])
            rows.append((observation, raw, self.log_prob(raw, mean), reward, terminated, done, after))
        return Batch(*(torch.stack(column) for column in zip(*rows, strict=True)))

    def log_prob(self, raw: Tensor, mean: Tensor) -> Tensor:
        """Log-density [...] of tanh(raw) where raw is normal: that of raw, less the log of tanh's derivative there."""
        standard = (raw - mean) * (-self.log_scale).exp()
        normal = -0.5 * standard.square() - self.log_scale - 0.5 * math.log(2 * math.pi)
        return (normal - 2 * (math.log(2) - raw - F.softplus(-2 * raw))).sum(-1)

    @torch.no_grad()
    def advantages(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Generalised advantage estimates and the critic's targets, [T, B] each."""
        value = self.critic(torch.cat([batch.observation, batch.after[-1:]])).squeeze(-1)
        value, later = value[:-1], value[1:].clone()
        # Where an episode was cut short the next row belongs to another one, but the critic still has a say.
        cut = batch.done & ~batch.terminated
        later[cut] = self.critic(batch.after[cut]).squeeze(-1)
        delta = batch.reward + self.gamma * later * ~batch.terminated - value
        decay = self.gamma * self.gae_lambda * ~batch.done
        running, advantage = torch.zeros_like(delta[0]), torch.empty_like(delta)
        for t in reversed(range(len(delta))):
            running = delta[t] + decay[t] * running
            advantage[t] = running
        return advantage, advantage + value

    def losses(
        self, observation: Tensor, raw: Tensor, log_prob: Tensor, advantage: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The clipped objective and the critic's loss of a minibatch [N]."""
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        ratio = (self.log_prob(raw, self.actor(observation)) - log_prob).exp()
        gain = torch.minimum(ratio * advantage, ratio.clamp(1 - self.clip, 1 + self.clip) * advantage)
        error = self.critic(observation).squeeze(-1) - target
        return -gain.mean(), self.critic_weight * error.square().mean()

    def update(self, batch: Batch, progress: float = 0.0) -> None:
        """Learn from a batch; `progress` is the share of the run that is over."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        columns = (batch.observation, batch.raw, batch.log_prob, *self.advantages(batch))
        flat = [column.flatten(0, 1) for column in columns]
        size = len(flat[0]) // self.minibatches
        for _ in range(self.epochs):
            order = torch.randperm(len(flat[0]), generator=self.generator)[: size * self.minibatches]
            for rows in order.to(flat[0].device).split(size):
                objective, critic = self.losses(*(column[rows] for column in flat))
                self.optimiser.zero_grad()
                (objective + critic).backward()
                nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
                self.optimiser.step()


def network(inputs: int, hidden: Sequence[int], outputs: int, gain: float) -> nn.Sequential:
    """A tanh network with PPO's orthogonal start."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_linear(inputs, width, gain=2**0.5), nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers, _linear(inputs, outputs, gain))


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
