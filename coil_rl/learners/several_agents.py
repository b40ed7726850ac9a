"""One reward for several agents."""

from tensordict import NestedKey, TensorDictBase

from coil_rl.learners.extension import Extension


class SummedRewards(Extension):
    """The sum of the rewards of several agents, which one policy of a joint action learns from.

    Args:
        reward_key: entry of a batch with the rewards, [B, T, agents, 1].
    """

    def __init__(self, reward_key: NestedKey) -> None:
        self.reward_key = reward_key

    def prepare(self, batch: TensorDictBase) -> None:
        """Write the sum of the rewards as `("next", "reward")`, [B, T, 1]."""
        rewards = batch[self.reward_key]
        agents = tuple(range(batch.ndim, rewards.ndim))
        batch["next", "reward"] = rewards.sum(agents)[..., None]
