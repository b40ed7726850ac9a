"""What is not part of an algorithm but changes its updates: statistics, further losses."""

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase


class Extension:
    """Base class of what is added to a learner; by itself it changes nothing.

    Learners call `meet` when they are made. An update calls `prepare` once, `weights` once,
    `losses` for each minibatch, and `finish` once. Learners with replay do not call `prepare`: they
    store the steps as they are, and learn from each many times.
    """

    @property
    def keys(self) -> Sequence[NestedKey]:
        """Entries that `losses` reads, besides those that the policy observes."""
        return ()

    def meet(self, env: EnvBase, policy: ProbabilisticTensorDictSequential, critics: Any) -> None:
        """Take what the losses need, or refuse what does not fit.

        Args:
            env: the env, for its specs.
            policy: of the learner, that `losses` is called with.
            critics: of actions, see `Critics`; None: the learner has none.
        """

    def prepare(self, batch: TensorDictBase) -> None:
        """Change a batch [B, T] in place, before advantages are computed from its rewards."""

    def losses(
        self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return further losses of a policy by name, scalars, for a minibatch [N]."""
        return {}

    def weights(self, weights: dict[str, float], progress: float) -> dict[str, float]:
        """Return the weights of all losses in the sum that is minimised.

        Args:
            weights: by name, those of the algorithm and of the extensions before this one.
            progress: of the run, in [0, 1].
        """
        return weights

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Act after an update with a batch [B, T], and return metrics by name."""
        return {}

    def begin_episodes(self) -> None:
        """Forget the running episodes: new ones begin with the next batch."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on; nothing by default."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""


class Extensions:
    """Several extensions as one; they act one after the other.

    Args:
        each: in the order in which they act.
    """

    def __init__(self, each: Sequence[Extension]) -> None:
        self.each = each

    @property
    def keys(self) -> Sequence[NestedKey]:
        """Entries that any of them reads."""
        return [key for each in self.each for key in each.keys]

    def prepare(self, batch: TensorDictBase) -> None:
        """Change a batch [B, T] in place."""
        for extension in self.each:
            extension.prepare(batch)

    def losses(
        self, policy: ProbabilisticTensorDictSequential, minibatch: Mapping[NestedKey, Tensor]
    ) -> dict[str, Tensor]:
        """Return the losses of all by name, scalars, for a minibatch [N]."""
        adding = [each for each in self.each if type(each).losses is not Extension.losses]
        if not adding:  # to make a TensorDict takes as long as a small loss
            return {}
        steps = TensorDict(dict(minibatch), len(next(iter(minibatch.values()))))
        losses: dict[str, Tensor] = {}
        for extension in adding:
            losses |= extension.losses(policy, steps)
        return losses

    def weights(self, weights: dict[str, float], progress: float) -> dict[str, float]:
        """Return the weights of all losses."""
        for extension in self.each:
            weights = extension.weights(weights, progress)
        return weights

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Let all act after an update, and return their metrics by name."""
        metrics: dict[str, float] = {}
        for extension in self.each:
            metrics |= extension.finish(batch, progress)
        return metrics

    def begin_episodes(self) -> None:
        """Tell all extensions that the running episodes do not go on."""
        for extension in self.each:
            extension.begin_episodes()

    def state_dict(self) -> dict[str, Any]:
        """Return the states of all, by their numbers."""
        return {str(number): each.state_dict() for number, each in enumerate(self.each)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the states of all."""
        for number, own in state.items():
            self.each[int(number)].load_state_dict(own)


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
