"""Batches of rollouts: their advantages, minibatches, who acted in them, and what is reported.

The report says, besides the losses, how far the policy moved and what the critic fits. It is
computed at the end for all minibatches together, because single ones take too long.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import GAE

from coil_rl.learners.learner import Stateful
from coil_rl.learners.networks import REMEMBERED
from coil_rl.learners.policy import Entries

AGENT_ACTS = "agent_acts"  # entry [*batch, 1]: whether the agent acted in a step
SEEN = ("log_ratio", "value", "value_target")  # of the losses, for `report_of`
OF_POLICY = ("clip_fraction", "kl_approx")


@torch.no_grad()
def add_advantages(
    batch: TensorDictBase, critic: TensorDictModuleBase, gamma: float, gae_lambda: float
) -> TensorDictBase:
    """Write `advantage` and `value_target` [B, T, 1] into a batch [B, T] of rollouts.

    It is generalised advantage estimation (Schulman et al. 2016) with one critic evaluation per
    state. The state after a step is the state before the next step, unless the episode ended. So
    the critic evaluates each state once, and in addition the last states of the batch and those of
    truncated episodes.

    Args:
        critic: writes `state_value`.
        gae_lambda: weight of later steps, in [0, 1]; 0: one step and the value after it; 1: all
            rewards to the end of the episode.
    """

    def values(states: TensorDictBase) -> Tensor:
        return critic(states.select(*critic.in_keys))["state_value"]

    after = batch["next"]
    value = values(batch)
    next_value = torch.cat([value[..., 1:, :], values(after[..., -1:])], -2)
    truncated = (after["done"] & ~after["terminated"]).squeeze(-1)
    next_value[truncated] = values(after.select(*critic.in_keys)[truncated])
    batch["state_value"], batch["next", "state_value"] = value, next_value
    estimate = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, vectorized=False)
    return estimate(batch)


def standardise(advantage: Tensor, least: float = 1e-6) -> Tensor:
    """Scale to mean 0 and standard deviation 1 over all entries.

    Args:
        advantage: of any shape.
        least: smaller standard deviations are taken as this one.
    """
    return (advantage - advantage.mean()) / advantage.std().clamp_min(least)


class Minibatches(Stateful):
    """Random minibatches of single steps.

    Args:
        epochs: passes over a batch, each in another random order.
        count: minibatches in each pass.
        seed: of the random orders.
    """

    parts: ClassVar[tuple[str, ...]] = ("generator",)

    def __init__(self, epochs: int, count: int, seed: int) -> None:
        self.epochs, self.count = epochs, count
        self.generator = torch.Generator().manual_seed(seed)

    def rows(self, batch: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
        """Return what minibatches are drawn from: entries of the steps of a batch, [B * T]."""
        return Entries({key: batch[key].flatten(0, batch.ndim - 1) for key in keys})

    def check(self, rows: int, steps: int) -> None:
        """Raise a `ValueError` if a batch of so many rows with so many steps each is too small."""
        if rows * steps < 2 * self.count:
            raise ValueError(
                f"minibatches={self.count} leaves less than 2 of {rows * steps} frames to each, "
                "too few to standardise advantages"
            )

    def draw(self, rows: Entries) -> Iterator[Entries]:
        """Yield the minibatches [N] of all passes over `rows`, which `check` must allow."""
        advantage = rows["advantage"]
        self.check(len(advantage), advantage.shape[1:].numel())
        size = len(advantage) // self.count
        for _ in range(self.epochs):
            order = torch.randperm(len(advantage), generator=self.generator)[: size * self.count]
            for index in order.to(advantage.device).split(size):
                yield Entries({key: rows[key].index_select(0, index) for key in rows})


class RowMinibatches(Minibatches):
    """Random minibatches of whole rows of a batch, for a policy with a memory.

    The GRU is run again from the stored first state of each row, so that gradients flow through
    time. After that the steps are a minibatch as any other.

    Args:
        memory: the part of the policy up to its GRU; it writes `remembered`.
    """

    def __init__(self, epochs: int, count: int, seed: int, memory: TensorDictModuleBase) -> None:
        super().__init__(epochs, count, seed)
        self.memory = memory

    def rows(self, batch: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
        """Return what minibatches are drawn from: entries of the rows of a batch, [B, T]."""
        rows = batch.select(*keys).reshape(-1, batch.shape[-1])
        return Entries({key: rows[key] for key in keys})

    def draw(self, rows: Entries) -> Iterator[Entries]:
        """Yield the minibatches [N] of all passes over `rows`, which `check` must allow."""
        yield from map(self.remember, super().draw(rows))

    def check(self, rows: int, steps: int) -> None:
        """Raise a `ValueError` if there are fewer rows than minibatches, or too few steps."""
        if rows < self.count:
            raise ValueError(
                f"minibatches={self.count} are more than the {rows} envs, but with a memory each "
                "needs all steps of an env; take fewer minibatches or more envs"
            )
        super().check(rows, steps)

    def remember(self, rows: Entries) -> Entries:
        """Return the steps of whole rows [N, T] with `remembered`, [N * T]."""
        read = {key: rows[key] for key in self.memory.in_keys}
        with set_recurrent_mode(True):
            remembered = self.memory(TensorDict(read, rows["advantage"].shape[:2]))[REMEMBERED]
        rows.set(REMEMBERED, remembered)
        return Entries({key: each.flatten(0, 1) for key, each in rows.items()})


def guide_may_act(env: EnvBase) -> bool:
    """Return whether a guide acts in some steps of an env, which then writes `agent_acts`."""
    return AGENT_ACTS in env.observation_spec


def of_agent(steps: Entries) -> Entries:
    """Return the steps of [N] in which the agent acted; all without the entry `agent_acts`."""
    if AGENT_ACTS not in steps:
        return steps
    acted = steps[AGENT_ACTS].squeeze(-1)
    return Entries({key: steps[key][acted] for key in steps})


@torch.no_grad()
def report_of(steps: Sequence[Mapping[str, Tensor]], clip: Sequence[float]) -> dict[str, float]:
    """Return the means over the minibatches of what is reported, by TorchRL's names.

    Args:
        steps: the entries `SEEN` of each minibatch, [N, 1] each; N may differ.
    """
    of_size: dict[int, list[Mapping[str, Tensor]]] = {}
    for step in steps:
        of_size.setdefault(len(step["log_ratio"]), []).append(step)
    parts = []
    for group in of_size.values():
        log_ratio, value, target = (torch.stack([step[name] for step in group]) for name in SEEN)
        parts.append(of_minibatches(log_ratio, value, target, clip))
    return {name: float(torch.cat([part[name] for part in parts]).mean()) for name in parts[0]}


def of_minibatches(
    log_ratio: Tensor, value: Tensor, target: Tensor, clip: Sequence[float]
) -> dict[str, Tensor]:
    """Return what is reported of some minibatches [S, N, 1], with one number for each."""
    share = (log_ratio.clamp(*clip) != log_ratio).to(log_ratio.dtype).mean((-2, -1))
    ratio, log_weights = log_ratio.exp(), log_ratio.squeeze(-1)
    unexplained = torch.var(target - value, correction=0, dim=-2)
    variance = torch.var(target, correction=0, dim=-2) + torch.finfo(target.dtype).eps
    effective_size = (2 * log_weights.logsumexp(-1) - (2 * log_weights).logsumexp(-1)).exp()
    return {
        "clip_fraction": share,
        "kl_approx": (-log_ratio).mean((-2, -1)),
        "explained_variance": 1.0 - unexplained / variance,
        "ESS": effective_size / log_weights.shape[-1],
        "max_ratio": ratio.amax((-2, -1)),
        "mean_ratio": ratio.mean((-2, -1)),
    }
