"""Gymnasium's CartPole-v1 as a batched env, a standard task for learners with discrete actions."""

import numpy as np
import torch
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from coil_rl.envs.seeded_env import SeededEnv


class CartPoles(SeededEnv):
    """B carts with poles; action 0 pushes left, 1 right.

    The reward is 1 per step; 475 steps per episode are a solution.
    """

    def __init__(self, count, seed=0):
        super().__init__(batch_size=[count])
        flag = Categorical(2, (count, 1), dtype=torch.bool)
        self.observation_spec = Composite(observation=Unbounded((count, 4)), shape=(count,))
        self.action_spec = Categorical(2, (count,))
        self.reward_spec = Bounded(0, 1, (count, 1))
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(count,)
        )
        self.generator = torch.Generator().manual_seed(seed)
        self.carts = CartPoleVectorEnv(count)
        self.carts.reset()

    def _reset(self, tensordict=None, **_):
        everywhere = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        begins = everywhere if tensordict is None else tensordict.get("_reset", everywhere)
        mask = begins.view(-1).numpy()
        state = torch.rand(*self.batch_size, 4, generator=self.generator).numpy() * 0.1 - 0.05
        self.carts.state[:, mask], self.carts.steps[mask] = state.T[:, mask], 0
        observation = torch.from_numpy(self.carts.state.T.astype(np.float32))
        return TensorDict({"observation": observation, **self.done_spec.zero()}, self.batch_size)

    def _step(self, tensordict):
        self.carts.prev_done[:] = False  # TorchRL resets carts, not Gymnasium
        result = self.carts.step(tensordict["action"].numpy())
        observation, reward, terminated, truncated = (torch.from_numpy(part) for part in result[:4])
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        columns = {key: value.unsqueeze(-1) for key, value in {"reward": reward, **ends}.items()}
        return TensorDict({"observation": observation, **columns}, self.batch_size)
