"""Measures of how much an agent uses the advice of each guide, and policies with changed advice.

Agreement alone cannot separate use of advice from coincidence: an agent and a guide may choose the
same action because both observe the same cones. `intervention` and `gradient` therefore change the
advice. All actions are deterministic.
"""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

ADVICE = "guide_action"

# Title and axis label of the picture of each measure.
PICTURES = {
    "intervention": ("Effect of other advice on the action", "change of the action"),
    "agreement": ("Difference between action and advice", "|action - advice|"),
    "gradient": ("Effect of small changes of the advice on the action", "|da / dg|"),
}

# Maps states [N] with `guide_action` to actions [N, A]; it may write to the states, which are
# copies.
Act = Callable[[TensorDictBase], Tensor]


def drawn(measures: Mapping[str, NDArray[np.float64]]) -> Iterator[tuple[str, str, str, str]]:
    """Yield the measures that can be drawn: those that have a picture and any number.

    Yields:
        The name of the measure, and title, axis label and file name of its picture.
    """
    for measure, (title, label) in PICTURES.items():
        if not np.isnan(measures[measure]).all():
            name = "listening" if measure == "intervention" else f"listening_{measure}"
            yield measure, title, label, f"{name}.png"


@torch.no_grad()
def agreement(act: Act, states: TensorDictBase) -> Tensor:
    """Return |a - g_k|, the distance between the action and the advice of each guide.

    Args:
        states: [N], with `guide_action` [N, n_guides, A].

    Returns:
        [N, n_guides], in the unit of the agent's action.
    """
    return (_act(act, states, states[ADVICE]).unsqueeze(-2) - states[ADVICE]).norm(dim=-1)


@torch.no_grad()
def intervention(
    act: Act, states: TensorDictBase, donors: int = 16, generator: torch.Generator | None = None
) -> Tensor:
    """Return the mean change of the action when one guide's advice comes from another state.

    Permutation importance (Breiman 2001) of the action instead of a loss: the replacement is a
    likely advice without information on this state; the advice of other guides stays. Donors come
    from all states, not from other cars at the same time, because deterministic cars on one track
    are in the same state at the same time. The change is [N, n_guides] in the unit of the
    agent's action; 0 if the advice has no influence.

    Args:
        states: [N], with `guide_action` [N, n_guides, A].
        donors: number of replacements per state and guide, at least 1.
        generator: of the donors, on the CPU; by default PyTorch's own.
    """
    advice = states[ADVICE]
    action, change = _act(act, states, advice), torch.zeros_like(advice[..., 0])
    for _ in range(donors):
        donor = torch.randint(len(advice), (len(advice),), generator=generator)
        other = advice[donor.to(advice.device)]
        for guide in range(advice.shape[-2]):
            replaced = advice.clone()
            replaced[:, guide] = other[:, guide]
            change[:, guide] += (_act(act, states, replaced) - action).norm(dim=-1)
    return change / donors


def gradient(act: Act, states: TensorDictBase) -> Tensor:
    """Return the effect of small changes of each guide's advice, the Frobenius norm of da/dg_k.

    It is 1 if the action is the advice, and NaN without a derivative, as for discrete actions.

    Args:
        states: [N], with `guide_action` [N, n_guides, A].

    Returns:
        [N, n_guides].
    """
    with torch.enable_grad():
        advice = states[ADVICE].detach().clone().requires_grad_()
        action = _act(act, states, advice)
        squares = torch.zeros_like(advice[..., 0])
        if not action.requires_grad:
            return squares.fill_(torch.nan)
        for component in action.sum(0):
            (slope,) = torch.autograd.grad(component, advice, retain_graph=True, allow_unused=True)
            if slope is not None:
                squares = squares + slope.square().sum(-1)
    return squares.detach().sqrt()


def _act(act: Act, states: TensorDictBase, advice: Tensor) -> Tensor:
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return act(states.copy().set(ADVICE, advice))


def split_policy(
    policy: TensorDictModuleBase,
) -> tuple[TensorDictModuleBase | None, TensorDictModuleBase]:
    """Split a policy into what writes `guide_action` and what reads it.

    Returns:
        The first module of the policy if it writes `guide_action`, else None; and the rest of it.

    Raises:
        ValueError: if the policy does not read advice.
    """
    advising, acting = None, policy
    if isinstance(policy, TensorDictSequential) and ADVICE in policy.module[0].out_keys:
        advising, others = policy.module[0], policy.module[1:]
        if hasattr(policy, "get_dist"):
            acting = ProbabilisticTensorDictSequential(*others)
        else:
            acting = TensorDictSequential(*others)
    if ADVICE not in acting.in_keys:
        raise ValueError(
            f"the policy does not read {ADVICE}; it reads {', '.join(map(str, acting.in_keys))}"
        )
    return advising, acting


class InterceptedPolicy(TensorDictModuleBase):
    """A policy whose input is changed between the advice and the action.

    Args:
        policy: the policy, which reads `guide_action`.
        change: returns the changed input of the acting part, given the input, which has
            `guide_action` [B, n_guides, A].
    """

    def __init__(
        self, policy: TensorDictModuleBase, change: Callable[[TensorDictBase], TensorDictBase]
    ) -> None:
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        super().__init__()
        self.advising, self.acting = split_policy(policy)
        self.change = change

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action; the changed input is not written.

        Args:
            tensordict: input of the policy, [B].
        """
        if self.advising is not None:
            tensordict = self.advising(tensordict)
        acted = self.acting(self.change(tensordict.copy()))
        return tensordict.update(acted.select(*self.acting.out_keys))
