"""A finite Markov decision process as a batched env, whose optimal policies are known."""

import torch
from tensordict import TensorDict
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, Composite, OneHot, Unbounded

from coil_rl.envs.seeded_env import SeededEnv


class TabularEnv(SeededEnv):
    """B agents with `action` [B] and one-hot `observation` [B, S].

    Absorbing states without reward terminate.

    `P` and `R` [S, A, S] are probabilities and rewards, `start` [S] the probabilities of the first
    state (uniform).
    """

    def __init__(self, P, R, num_envs=64, start=None, max_steps=100, seed=0):
        super().__init__(batch_size=torch.Size([num_envs]))
        self.P, self.R = torch.as_tensor(P).double(), torch.as_tensor(R).double()
        states, actions = self.P.shape[:2]
        if start is None:
            start = torch.full((states,), 1 / states)
        self.start = torch.as_tensor(start).double()
        stays = torch.diagonal(self.P, dim1=0, dim2=2).T == 1
        self.terminal = (stays & ((self.P * self.R).sum(2) == 0)).all(1)
        self.max_steps, self.generator = max_steps, torch.Generator()
        batch = self.batch_size
        self.observation_spec = Composite(
            observation=OneHot(states, (*batch, states), dtype=torch.float32), shape=batch
        )
        self.action_spec = Categorical(actions, batch, dtype=torch.int64)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32)
        ends = ("done", "terminated", "truncated")
        self.done_spec = Composite(
            {key: Binary(1, (*batch, 1), dtype=torch.bool) for key in ends}, shape=batch
        )
        self.set_seed(seed)

    def _draw(self, probabilities):
        drawn = torch.rand((*self.batch_size, 1), generator=self.generator, dtype=torch.float64)
        return (probabilities.cumsum(-1) <= drawn).sum(-1).clamp(max=len(self.start) - 1)

    def _output(self, **others):
        observation = F.one_hot(self.state, len(self.start)).float()
        return TensorDict({"observation": observation, **others}, self.batch_size)

    def _reset(self, tensordict=None, **_):
        state, steps = self._draw(self.start), torch.zeros(self.batch_size, dtype=torch.int64)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"].view(-1)
            state, steps = (
                torch.where(mask, state, self.state),
                torch.where(mask, steps, self.steps),
            )
        self.state, self.steps = state, steps
        return self._output()

    def _step(self, tensordict):
        action, before = tensordict["action"], self.state
        self.state, self.steps = self._draw(self.P[before, action]), self.steps + 1
        terminated = self.terminal[self.state].unsqueeze(-1)
        truncated = (self.steps >= self.max_steps).unsqueeze(-1) & ~terminated
        reward = self.R[before, action, self.state].float().unsqueeze(-1)
        return self._output(
            reward=reward, terminated=terminated, truncated=truncated, done=terminated | truncated
        )
