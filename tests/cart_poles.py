"""Gymnasium's CartPole-v1 as a batched env, a standard task for learners with discrete actions."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from coil_rl.envs.cone_track import SeededEnv

LIMIT = 500


class CartPoles(SeededEnv):
    """B carts; action 0 pushes left, 1 right. The reward is 1 per step; 475 steps per episode are a solution."""

    batch_locked = True

    def __init__(self, count, seed=0):
        super().__init__(batch_size=[count])
        flag = Categorical(2, (count, 1), dtype=torch.bool)
        self.observation_spec = Composite(observation=Unbounded((count, 4)), shape=(count,))
        self.action_spec = Categorical(2, (count,))
        self.reward_spec = Bounded(0, 1, (count, 1))
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(count,))
        self.generator = torch.Generator().manual_seed(seed)
        self.register_buffer("state", torch.zeros(count, 4))
        self.register_buffer("steps", torch.zeros(count, 1, dtype=torch.int64))

    def _reset(self, tensordict=None, **_):
        new = torch.rand(*self.batch_size, 4, generator=self.generator) * 0.1 - 0.05
        fresh = torch.ones_like(self.steps, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            fresh = tensordict["_reset"].view_as(fresh)
        self.state = torch.where(fresh, new, self.state)
        self.steps = torch.where(fresh, 0, self.steps)
        none = torch.zeros_like(fresh)
        done = {"done": none, "terminated": none.clone(), "truncated": none.clone()}
        return TensorDict({"observation": self.state.clone(), **done}, self.batch_size)

    def _step(self, tensordict):
        x, speed, angle, turn = self.state.unbind(-1)
        force = tensordict["action"] * 20.0 - 10.0
        push = (force + 0.05 * turn**2 * angle.sin()) / 1.1
        turning = (9.8 * angle.sin() - angle.cos() * push) / (0.5 * (4 / 3 - 0.1 * angle.cos() ** 2 / 1.1))
        faster = push - 0.05 * turning * angle.cos() / 1.1
        x, speed, angle, turn = x + 0.02 * speed, speed + 0.02 * faster, angle + 0.02 * turn, turn + 0.02 * turning
        self.state = torch.stack([x, speed, angle, turn], -1)
        self.steps = self.steps + 1
        fallen = ((x.abs() > 2.4) | (angle.abs() > 0.20943951)).unsqueeze(-1)
        late = self.steps >= LIMIT
        done = {"done": fallen | late, "terminated": fallen, "truncated": late}
        reward = torch.ones(*self.batch_size, 1)
        return TensorDict({"observation": self.state.clone(), "reward": reward, **done}, self.batch_size)
