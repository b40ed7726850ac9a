"""What is not part of an algorithm but changes its updates: statistics, further losses."""

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor


class Extension:
    """Base class of what is added to a learner; by itself it changes nothing.

    An update calls `prepare` once, `weights` once, `losses` for each minibatch, and `finish` once.
    Learners with replay do not call `prepare`: they store the steps as they are, and learn from
    each many times.
    """

    @property
    def keys(self) -> Sequence[NestedKey]:
        """Entries that `losses` reads, besides those that the policy observes."""
        return ()

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

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on; nothing by default."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
