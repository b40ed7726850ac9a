"""What an update of PPO reports besides its losses: how far the policy moved, what the critic fits.

It is computed at the end for all minibatches together, because single ones take too long.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

SEEN = ("log_ratio", "value", "value_target")  # what the losses of a minibatch return for it
OF_POLICY = ("clip_fraction", "kl_approx")


@torch.no_grad()
def report_of(steps: Sequence[Mapping[str, Tensor]], clip: Sequence[float]) -> dict[str, float]:
    """Return the means over the minibatches of what is reported, by TorchRL's names.

    Args:
        steps: the entries `SEEN` of each minibatch, [N, 1] each; N may differ.
    """
    of_size: dict[int, list[Mapping[str, Tensor]]] = {}
    for step in steps:
        of_size.setdefault(len(step["log_ratio"]), []).append(step)
    parts = []
    for group in of_size.values():
        log_ratio, value, target = (torch.stack([step[name] for step in group]) for name in SEEN)
        parts.append(of_minibatches(log_ratio, value, target, clip))
    return {name: float(torch.cat([part[name] for part in parts]).mean()) for name in parts[0]}


def of_minibatches(
    log_ratio: Tensor, value: Tensor, target: Tensor, clip: Sequence[float]
) -> dict[str, Tensor]:
    """Return what is reported of some minibatches [S, N, 1], with one number for each."""
    share = (log_ratio.clamp(*clip) != log_ratio).to(log_ratio.dtype).mean((-2, -1))
    ratio, log_weights = log_ratio.exp(), log_ratio.squeeze(-1)
    unexplained = torch.var(target - value, correction=0, dim=-2)
    variance = torch.var(target, correction=0, dim=-2) + torch.finfo(target.dtype).eps
    effective_size = (2 * log_weights.logsumexp(-1) - (2 * log_weights).logsumexp(-1)).exp()
    return {
        "clip_fraction": share,
        "kl_approx": (-log_ratio).mean((-2, -1)),
        "explained_variance": 1.0 - unexplained / variance,
        "ESS": effective_size / log_weights.shape[-1],
        "max_ratio": ratio.amax((-2, -1)),
        "mean_ratio": ratio.mean((-2, -1)),
    }
