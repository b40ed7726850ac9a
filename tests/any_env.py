"""Envs with any kinds of observations and actions."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, OneHot, Unbounded

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.learners import DQN
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.run.rollout import Rollout

FLOAT64 = {"dtype": torch.float64}


class AnyEnv(SeededEnv):
    """B rows that show random observations; episodes are truncated after 5 steps.

    The reward is highest for the action 0.5, or for the last option of each choice.
    """

    def __init__(
        self, count=8, action=None, observations=None, dtype=torch.float32, agents=False, seed=0
    ):
        super().__init__(batch_size=[count])
        action = Bounded(-1, 1, (2,)) if action is None else action
        shown = observations or {"observation": Unbounded((3,), dtype=dtype)}
        self.key, self.reward = "action", "reward"
        if agents:
            self.key, self.reward = ("agents", "action"), ("agents", "reward")
        self.observation_spec = Composite(
            {key: spec.expand(count, *spec.shape) for key, spec in shown.items()}, shape=(count,)
        )
        self.full_action_spec = self.nested(self.key, action.expand(count, *action.shape))
        shape = (count, action.shape[0], 1) if agents else (count, 1)
        self.full_reward_spec = self.nested(self.reward, Unbounded(shape, dtype=dtype))
        flag = Categorical(2, (count, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(count,)
        )
        self.steps = torch.zeros(count, 1, dtype=torch.long)
        self.generator = torch.Generator().manual_seed(seed)

    def nested(self, key, spec):
        if isinstance(key, str):
            return Composite({key: spec}, shape=self.batch_size)
        return Composite({key[0]: self.nested(key[1], spec)}, shape=self.batch_size)

    def observe(self):
        return {key: spec.rand() for key, spec in self.observation_spec.items(True, True)}

    def _reset(self, tensordict=None, **_):
        everywhere = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        self.steps[everywhere if tensordict is None else tensordict.get("_reset", everywhere)] = 0
        return TensorDict(self.observe() | dict(self.full_done_spec.zero()), self.batch_size)

    def _step(self, tensordict):
        spec, action = self.full_action_spec[self.key], tensordict[self.key]
        if spec.dtype.is_floating_point:
            score = -(action - 0.5).square()
        elif hasattr(spec, "nvec"):
            score = (action == spec.nvec - 1).float()
        elif isinstance(spec, OneHot):
            score = action[..., -1].float()
        else:
            score = (action == spec.space.n - 1).float()
        reward = self.full_reward_spec[self.reward]
        score = score.reshape(*reward.shape[:-1], -1).mean(-1, keepdim=True).to(reward.dtype)
        self.steps += 1
        truncated = self.steps >= 5
        ends = {"done": truncated, "truncated": truncated}
        ends["terminated"] = torch.zeros_like(truncated)
        return TensorDict(self.observe() | {self.reward: score} | ends, self.batch_size)


def action_of(kind):
    """Return the action that a kind of learner can choose; None: any."""
    return Categorical(3, ()) if kind is DQN else None


def learning(kind, env, *args, **options):
    """Return a small learner in an env, and its rollout."""
    replay = {"starts": 16, "batch_size": 16, "updates_per_step": 0.0625}
    small = replay if issubclass(kind, OffPolicy) else {"minibatches": 2}
    learner = kind(env, *args, **small | options)
    return learner, Rollout(env, learner.policy, 8, learner.keys)


def check_same_update(one, other, batch):
    """Check that two learners report the same for an update with a batch, and become the same."""
    reports = []
    for learner in (one, other):
        torch.manual_seed(1)
        reports.append(learner.update(batch.clone()))
    assert reports[0] == reports[1]
    theirs = other.policy.state_dict()
    assert all(torch.equal(value, theirs[key]) for key, value in one.policy.state_dict().items())
