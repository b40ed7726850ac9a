"""Any finite Markov decision process as a batched TorchRL env, such as the toymaker."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, OneHot, Unbounded

from coil_rl.envs.seeded import SeededEnv


class TabularEnv(SeededEnv):
    """B agents, each in a state of a finite Markov decision process.

    Reads `action` [B], the number of an action. Writes `observation` [B, S], 1 at the state and else 0, and `reward`,
    `done`, `terminated`, `truncated` [B, 1]. An episode terminates in a state that every action leaves as it is, for
    nothing. All state is in buffers, so `state_dict()` is the whole of it.

    Args:
        P: [S, A, S], P[s, a, s'] the probability that action a leads from state s to state s'.
        R: [S, A, S], R[s, a, s'] the reward of that transition.
        num_envs: B.
        start: [S], the probability of each state to be the first one; all alike where it is not given.
        max_steps: after which an episode is truncated.
        seed: of all that is left to chance.
        device: where everything lives.

    Raises:
        ValueError: for what is no Markov decision process, naming state and action, and for numbers less than 1.

    Example:
        >>> from coil_rl.envs import TabularEnv
        >>> from coil_rl.tabular import toymaker
        >>> mdp = toymaker()
        >>> TabularEnv(mdp.P, mdp.R, num_envs=8).rollout(3)["observation"].shape
        torch.Size([8, 3, 2])
    """

    state: Tensor
    steps: Tensor
    following: Tensor
    rewards: Tensor
    beginning: Tensor
    terminal: Tensor

    def __init__(
        self,
        P: ArrayLike,
        R: ArrayLike,
        num_envs: int = 64,
        *,
        start: ArrayLike | None = None,
        max_steps: int = 100,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        chances, rewards = (torch.as_tensor(table, dtype=torch.float64) for table in (P, R))
        if chances.ndim != 3 or len(chances) != chances.shape[2] or rewards.shape != chances.shape:
            raise ValueError(
                f"P and R must both have the shape [S, A, S]; they have {list(chances.shape)}, {list(rewards.shape)}"
            )
        states, actions = chances.shape[:2]
        _check_probabilities("P", chances)
        if not rewards.isfinite().all():
            raise ValueError(f"R{_first(~rewards.isfinite())} must be finite: state, action, next state")
        alike = [1 / states] * states
        first = torch.as_tensor(alike if start is None else start, dtype=torch.float64)
        if first.shape != (states,):
            raise ValueError(f"start must be {states} probabilities, one a state; it has the shape {list(first.shape)}")
        _check_probabilities("start", first)
        for name, value in {"num_envs": num_envs, "max_steps": max_steps}.items():
            if value < 1:
                raise ValueError(f"{name}={value} must be at least 1")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.max_steps = max_steps
        self.generator = torch.Generator()
        stays = torch.diagonal(chances, dim1=0, dim2=2).T == 1
        fixed = {
            "following": _cumulative(chances), "rewards": rewards.float(), "beginning": _cumulative(first),
            "terminal": (stays & ((chances * rewards).sum(2) == 0)).all(1),
        }  # fmt: skip
        for name, table in fixed.items():
            self.register_buffer(name, table.to(self.device), persistent=False)
        self.register_buffer("state", torch.zeros(num_envs, dtype=torch.int64, device=self.device))
        self.register_buffer("steps", torch.zeros(num_envs, dtype=torch.int64, device=self.device))
        self._declare_specs(states, actions)
        self.set_seed(seed)

    def _declare_specs(self, states: int, actions: int) -> None:
        batch, device = self.batch_size, self.device
        flag = Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device)
        seen = OneHot(states, (*batch, states), dtype=torch.float32, device=device)
        self.observation_spec = Composite(observation=seen, shape=batch)
        self.action_spec = Categorical(actions, batch, dtype=torch.int64, device=device)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32, device=device)
        self.done_spec = Composite(
            {key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=batch, device=device
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        # All agents draw, reset or not: which numbers come next must not depend on the data.
        state, steps = self._draw(self.beginning), torch.zeros_like(self.steps)
        if mask is not None:
            state, steps = (torch.where(mask.view(-1), *pair) for pair in ((state, self.state), (steps, self.steps)))
        self.state, self.steps = state, steps
        return self._observation()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action, before = tensordict["action"], self.state
        self.state, self.steps = self._draw(self.following[before, action]), self.steps + 1
        out = self._observation()
        terminated = self.terminal[self.state].unsqueeze(-1)
        truncated = (self.steps >= self.max_steps).unsqueeze(-1) & ~terminated
        out["reward"] = self.rewards[before, action, self.state].unsqueeze(-1)
        out["terminated"], out["truncated"], out["done"] = terminated, truncated, terminated | truncated
        return out

    def _draw(self, cumulative: Tensor) -> Tensor:
        """[B]: a state each, from cumulative probabilities [S] or [B, S]."""
        drawn = torch.rand((*self.batch_size, 1), generator=self.generator, dtype=torch.float64).to(self.device)
        return (cumulative <= drawn).sum(-1)

    def _observation(self) -> TensorDictBase:
        seen = torch.nn.functional.one_hot(self.state, len(self.terminal)).float()
        return TensorDict({"observation": seen}, self.batch_size, device=self.device)


def _check_probabilities(name: str, chances: Tensor) -> None:
    total = chances.sum(-1)
    # What is not a number is not within bounds either.
    wrong = ~(((total - 1).abs() < 1e-9) & (chances >= 0).all(-1))
    if wrong.any():
        where = _first(wrong) if wrong.ndim else ""
        which = " in this state, of this action" if wrong.ndim else ""
        raise ValueError(f"{name}{where} must be probabilities{which}: none below 0, and a sum of 1")


def _first(wrong: Tensor) -> list[int]:
    """Where the first one is that is wrong."""
    place: list[int] = wrong.nonzero()[0].tolist()
    return place


def _cumulative(chances: Tensor) -> Tensor:
    """Along the last axis; ends at exactly 1, so that a draw below 1 never finds what has probability 0."""
    total = chances.cumsum(-1)
    return total / total[..., -1:]
