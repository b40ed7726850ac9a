"""How much an agent listens to each of its guides, in given states.

Agreement alone cannot tell listening from coincidence: an agent that sees the road and one that copies a guide who sees
it do the same. So the advice is changed and the agent asked again. All actions are the deterministic ones.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.listening.parts import ADVICE

Act = Callable[[TensorDictBase], Tensor]
"""From states [N] with `guide_action` to actions [N, A]; what it writes into the states is thrown away."""


@torch.no_grad()
def agreement(act: Act, states: TensorDictBase) -> Tensor:
    """How far the action is from each guide's, |a - g_k|.

    Args:
        act: the agent.
        states: [N], with `guide_action` [N, n_guides, A].

    Returns:
        [N, n_guides] in action units; 0 is full agreement.
    """
    return (_asked(act, states, states[ADVICE]).unsqueeze(-2) - states[ADVICE]).norm(dim=-1)


@torch.no_grad()
def intervention(
    act: Act, states: TensorDictBase, donors: int = 16, generator: torch.Generator | None = None
) -> Tensor:
    """How far the action moves when one guide's advice is replaced by what it said elsewhere.

    The replacement is drawn from what the same guide said in all the states: likely advice that says nothing about this
    one, all other advice staying as it is (permutation importance, Breiman 2001, of the action instead of a loss).
    Deterministic cars on one track are at the same place at the same moment, so another car of that moment would not
    do; another state of the same drives has the distribution that it would have if they were spread out.

    Args:
        act: the agent.
        states: [N], with `guide_action` [N, n_guides, A].
        donors: replacements of each piece of advice, over which the mean is taken.
        generator: of the draws, on the CPU.

    Returns:
        [N, n_guides] in action units; 0 where a guide is not listened to.

    Raises:
        ValueError: if there are no donors.
    """
    if donors < 1:
        raise ValueError(f"donors={donors} must be at least 1")
    advice = states[ADVICE]
    before, moved = _asked(act, states, advice), torch.zeros_like(advice[..., 0])
    for _ in range(donors):
        other = advice[torch.randint(len(advice), (len(advice),), generator=generator).to(advice.device)]
        for guide in range(advice.shape[-2]):
            replaced = advice.clone()
            replaced[:, guide] = other[:, guide]
            moved[:, guide] += (_asked(act, states, replaced) - before).norm(dim=-1)
    return moved / donors


def gradient(act: Act, states: TensorDictBase) -> Tensor:
    """How the action follows small changes of each guide's advice: the Frobenius norm of da/dg_k.

    Args:
        act: the agent.
        states: [N], with `guide_action` [N, n_guides, A].

    Returns:
        [N, n_guides]; 1 where the action is the guide's, NaN if nothing can be differentiated, as in a choice.
    """
    with torch.enable_grad():
        advice = states[ADVICE].detach().clone().requires_grad_()
        action = _asked(act, states, advice)
        squares = torch.zeros_like(advice[..., 0])
        if not action.requires_grad:
            return squares.fill_(torch.nan)
        for component in action.sum(0):
            (slope,) = torch.autograd.grad(component, advice, retain_graph=True, allow_unused=True)
            if slope is not None:
                squares = squares + slope.square().sum(-1)
    return squares.detach().sqrt()


def _asked(act: Act, states: TensorDictBase, advice: Tensor) -> Tensor:
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return act(states.copy().set(ADVICE, advice))
