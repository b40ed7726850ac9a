"""The extensions of a learner as one, and those that the arguments of a learner ask for."""

from collections.abc import Iterable, Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.extension import Extension
from coil_rl.learners.normaliser import Normaliser, RawObservations, RunningStatistics
from coil_rl.learners.reward_scale import RewardScale
from coil_rl.learners.several_agents import SummedRewards


class Extensions(Extension):
    """Several extensions as one; they act one after the other.

    Args:
        extensions: in the order in which they act.
        raw: what is observed as it is, looked at after the first update; None: nothing.
    """

    def __init__(self, extensions: Iterable[Extension], raw: RawObservations | None = None) -> None:
        self.each, self.raw = list(extensions), raw

    @property
    def keys(self) -> Sequence[NestedKey]:
        """Entries that any of them reads."""
        return [key for each in self.each for key in each.keys]

    def prepare(self, batch: TensorDictBase) -> None:
        """Change a batch [B, T] in place."""
        for extension in self.each:
            extension.prepare(batch)

    @property
    def has_losses(self) -> bool:
        """Whether any of them adds losses."""
        return any(type(each).losses is not Extension.losses for each in self.each)

    def losses(
        self, policy: ProbabilisticTensorDictSequential, minibatch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the losses of all by name, scalars, for a minibatch [N]."""
        losses: dict[str, Tensor] = {}
        for extension in self.each:
            losses |= extension.losses(policy, minibatch)
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
        if self.raw is not None:
            self.raw.look(batch)
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the states of all, by their numbers."""
        return {str(number): each.state_dict() for number, each in enumerate(self.each)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the states of all."""
        for number, each in enumerate(self.each):
            each.load_state_dict(state[str(number)])


def extensions_of(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    scale: RewardScale | None,
    normaliser: Normaliser | None,
    auxiliary: Sequence[Extension],
) -> Extensions:
    """Return the extensions of an on-policy learner, in their order.

    Args:
        env: the env; the rewards of several agents are summed.
        scale: of the rewards; None: they stay as they are.
        normaliser: of the policy; None: it has none.
    """
    extensions: list[Extension] = []
    if (reward_key := unravel_key(("next", env.reward_key))) != ("next", "reward"):
        extensions.append(SummedRewards(reward_key))
    if scale is not None:
        extensions.append(scale)
    if normaliser is not None:
        extensions.append(RunningStatistics(normaliser))
    extensions += auxiliary
    return Extensions(extensions, RawObservations(env, in_keys, normaliser))
