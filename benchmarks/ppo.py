"""PPO in plain PyTorch, as a yardstick of the overhead of `coil_rl.learners.PPO`.

The numbers are the same (tests/benchmarks/test_ppo.py). Collection and update are one class, as in
CleanRL: it calls the env directly, without transforms, actors, loss modules or value estimators.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase

from coil_rl.schedules import schedule


class Batch(NamedTuple):
    """T steps of B cars.

    Attributes:
        observation: [T, B, D], including the advice.
        raw: [T, B, A], the action before tanh.
        log_prob: [T, B], log-density of the action.
        reward: [T, B].
        terminated: [T, B].
        done: [T, B], terminated or truncated.
        after: [T, B, D], the next observation before any reset.
    """

    observation: Tensor
    raw: Tensor
    log_prob: Tensor
    reward: Tensor
    terminated: Tensor
    done: Tensor
    after: Tensor


class PlainPPO:
    """Networks, rollout and update.

    Args:
        env: batched env with an action bounded by -1 and 1.
        guide: guide with an action that is appended to the observation; None for plain PPO.
        steps: T.
        hyper_parameters: all those of conf/learner/ppo.yaml.
    """

    def __init__(
        self,
        env: EnvBase,
        guide: TensorDictModuleBase | None,
        steps: int,
        **hyper_parameters: Any,
    ) -> None:
        self.env, self.guide, self.steps = env, guide, steps
        self.hyper = hyper = SimpleNamespace(**hyper_parameters)
        if hyper.entropy:
            raise ValueError(f"entropy={hyper.entropy} must be 0: PPO by hand has no entropy bonus")
        self.learning_rate = schedule(hyper.learning_rate)
        with torch.no_grad():
            self.observation = self.observe(env._reset(None))
        size, inputs = env.action_spec.shape[-1], self.observation.shape[-1]
        self.actor = network(inputs, hyper.hidden, size, gain=hyper.action_gain).to(env.device)
        self.critic = network(inputs, hyper.hidden, 1, gain=1.0).to(env.device)
        self.log_scale = nn.Parameter(
            torch.full((size,), math.log(hyper.action_scale), device=env.device)
        )
        self.parameters = [*self.actor.parameters(), self.log_scale, *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(
            self.parameters, lr=self.learning_rate(0), eps=1e-5, fused=True
        )
        self.generator = torch.Generator().manual_seed(hyper.seed)

    def observe(self, state: TensorDictBase) -> Tensor:
        """Return the observation of the agent, [B, D]."""
        observation: Tensor = state["observation"]
        if self.guide is None:
            return observation
        return torch.cat([observation, self.guide(state.select(*self.guide.in_keys))["action"]], -1)

    @torch.no_grad()
    def collect(self) -> Batch:
        """Drive for T steps with sampled actions and reset cars that are done."""
        rows = []
        keys = ["observation", *(self.guide.in_keys if self.guide is not None else [])]
        for _ in range(self.steps):
            observation = self.observation
            mean = self.actor(observation)
            raw = mean + self.log_scale.exp() * torch.randn_like(mean)
            state = self.env._step(TensorDict({"action": raw.tanh()}, self.env.batch_size))
            self.observation = after = self.observe(state)
            reward, terminated, done = (
                state[key].squeeze(-1) for key in ("reward", "terminated", "done")
            )
            if done.any():
                fresh = self.env._reset(TensorDict({"_reset": done}, self.env.batch_size))
                self.observation = after.clone()
                self.observation[done] = self.observe(fresh.select(*keys)[done])
            log_prob = self.log_prob(raw, mean)
            rows.append((observation, raw, log_prob, reward, terminated, done, after))
        return Batch(*(torch.stack(column) for column in zip(*rows, strict=True)))

    def log_prob(self, raw: Tensor, mean: Tensor) -> Tensor:
        """Return the log-density of tanh(raw), [...], summed over the action's components.

        It is the log-density of the normal raw action minus the log-derivative of tanh.
        """
        standard = (raw - mean) * (-self.log_scale).exp()
        normal = -0.5 * standard.square() - self.log_scale - 0.5 * math.log(2 * math.pi)
        return (normal - 2 * (math.log(2) - raw - F.softplus(-2 * raw))).sum(-1)

    @torch.no_grad()
    def advantages(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return generalised advantage estimates and the targets of the critic, [T, B] each."""
        value = self.critic(torch.cat([batch.observation, batch.after[-1:]])).squeeze(-1)
        value, following = value[:-1], value[1:].clone()
        # The next row of a truncated episode is another episode, so its value is computed
        # separately.
        truncated = batch.done & ~batch.terminated
        following[truncated] = self.critic(batch.after[truncated]).squeeze(-1)
        delta = batch.reward + self.hyper.gamma * following * ~batch.terminated - value
        decay = self.hyper.gamma * self.hyper.gae_lambda * ~batch.done
        running, advantage = torch.zeros_like(delta[0]), torch.empty_like(delta)
        for t in reversed(range(len(delta))):
            running = delta[t] + decay[t] * running
            advantage[t] = running
        return advantage, advantage + value

    def loss(
        self, observation: Tensor, raw: Tensor, log_prob: Tensor, advantage: Tensor, target: Tensor
    ) -> Tensor:
        """Return the clipped objective plus the weighted critic loss of a minibatch [N]."""
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        ratio = (self.log_prob(raw, self.actor(observation)) - log_prob).exp()
        clipped = ratio.clamp(1 - self.hyper.clip, 1 + self.hyper.clip)
        gain = torch.minimum(ratio * advantage, clipped * advantage)
        error = self.critic(observation).squeeze(-1) - target
        return self.hyper.critic * error.square().mean() - gain.mean()

    def update(self, batch: Batch, progress: float = 0.0) -> None:
        """Learn from a batch; `progress` is the completed fraction of the run."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        columns = (batch.observation, batch.raw, batch.log_prob, *self.advantages(batch))
        # Car by car, as a TorchRL batch.
        flat = [column.transpose(0, 1).flatten(0, 1) for column in columns]
        size = len(flat[0]) // self.hyper.minibatches
        for _ in range(self.hyper.epochs):
            order = torch.randperm(len(flat[0]), generator=self.generator)
            order = order[: size * self.hyper.minibatches]
            for rows in order.to(flat[0].device).split(size):
                loss = self.loss(*(column[rows] for column in flat))
                self.optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.parameters, self.hyper.max_grad_norm)
                self.optimiser.step()


def network(inputs: int, hidden: Sequence[int], outputs: int, gain: float) -> nn.Sequential:
    """Return a tanh network with orthogonal initial weights."""
    layers: list[nn.Module] = []
    for width, scale in [*((width, 2**0.5) for width in hidden), (outputs, gain)]:
        layer = nn.Linear(inputs, width)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers[:-1])
