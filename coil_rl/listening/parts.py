"""A policy in two parts: who advises and who acts. What is measured happens between the two.

Whether the advice is part of what the env shows or is worked out by the policy's own first module makes no difference
then, and the env's transforms still see what the guides really said.
"""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, TensorDictSequential

ADVICE = "guide_action"


def split(policy: TensorDictModuleBase) -> tuple[TensorDictModuleBase | None, TensorDictModuleBase]:
    """The part of a policy that writes the advice, if the env does not, and the part that acts on it.

    Args:
        policy: a sequence of modules of which the first may write `guide_action`, or any module that reads it.

    Raises:
        ValueError: if it acts without reading advice.
    """
    advising, acting = None, policy
    if isinstance(policy, TensorDictSequential) and ADVICE in policy.module[0].out_keys:
        kind = ProbabilisticTensorDictSequential if hasattr(policy, "get_dist") else TensorDictSequential
        advising, acting = policy.module[0], kind(*policy.module[1:])
    if ADVICE not in acting.in_keys:
        raise ValueError(f"the policy does not read {ADVICE}; it reads {', '.join(map(str, acting.in_keys))}")
    return advising, acting


class Intercepted(TensorDictModuleBase):
    """A policy with something done to what it sees, after it was advised and before it acts.

    Args:
        policy: as for `split`.
        between: takes what the policy sees, with `guide_action` [B, n_guides, A], and returns what it shall see.

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> import torch
        >>> follow = TensorDictModule(lambda advice: advice[:, 0], in_keys=["guide_action"], out_keys=["action"])
        >>> deaf = Intercepted(follow, lambda seen: seen.set("guide_action", seen["guide_action"] * 0))
        >>> deaf(TensorDict({"guide_action": torch.ones(3, 2, 1)}, [3]))["action"].flatten().tolist()
        [0.0, 0.0, 0.0]
    """

    def __init__(self, policy: TensorDictModuleBase, between: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        super().__init__()
        self.advising, self.acting = split(policy)
        self.between = between

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action; what was changed in between is not written."""
        if self.advising is not None:
            tensordict = self.advising(tensordict)
        acted = self.acting(self.between(tensordict.copy()))
        return tensordict.update(acted.select(*self.acting.out_keys))
