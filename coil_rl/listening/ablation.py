"""What it costs an agent when one guide falls silent, everywhere or at one kind of place only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.listening.parts import ADVICE, Intercepted
from coil_rl.listening.places import PLACES, Places
from coil_rl.train.evaluation import evaluate_policy


class Ablation(NamedTuple):
    """Which slot of the advice is removed where.

    Attributes:
        guide: the slot.
        place: index in PLACES; None for everywhere.
    """

    guide: int
    place: int | None = None


def ablations(guides: int) -> list[Ablation]:
    """Each of so many guides removed everywhere, then at each kind of place."""
    return [Ablation(guide, place) for guide in range(guides) for place in (None, *range(len(PLACES)))]


def drive_ablated(
    env: EnvBase,
    policy: TensorDictModuleBase,
    places: Places,
    removed: Sequence[Ablation],
    silence: Tensor,
    *,
    names: Sequence[str] = (),
    tick: Callable[[], Any] | None = None,
) -> list[list[dict[str, Any]]]:
    """Drive the deterministic agent once with each ablation, all of them at the same time.

    A slot cannot be left out of a network, so a removed one says always the same: the mean of what it says, which tells
    nothing about now and is the least out of the ordinary. Advice drawn from elsewhere would tell as little, but it
    would mislead an agent that listens, and so mix up what is missing with what is wrong.

    Args:
        env: cars with `info`; each ablation gets an equal share of them, in the order of both.
        policy: the agent; reads `guide_action`.
        places: of the tracks of this env.
        removed: the ablations.
        silence: [n_guides, A], what a removed guide says.
        names: of the tracks.
        tick: called every step.

    Returns:
        The episodes of each ablation, as in `Drive`.

    Raises:
        ValueError: if the cars cannot be shared out.
    """
    cars = env.batch_size.numel()
    if not removed or cars % len(removed):
        raise ValueError(f"{cars} cars cannot be shared out to {len(removed)} ablations; give a multiple")
    share = cars // len(removed)
    everywhere = -1
    slot = torch.tensor([one.guide for one in removed], device=env.device).repeat_interleave(share)
    place = torch.tensor([everywhere if one.place is None else one.place for one in removed], device=env.device)
    place = place.repeat_interleave(share)
    of_guide = slot.unsqueeze(-1) == torch.arange(len(silence), device=env.device)

    def remove(seen: TensorDictBase) -> TensorDictBase:
        here = places.kind(seen["info", "track"].squeeze(-1), seen["info", "pose"][..., :2])
        silent = of_guide & ((place == everywhere) | (place == here)).unsqueeze(-1)
        return seen.set(ADVICE, torch.where(silent.unsqueeze(-1), silence, seen[ADVICE]))

    episodes = evaluate_policy(env, Intercepted(policy, remove), names=names, tick=tick).episodes
    return [episodes[start : start + share] for start in range(0, cars, share)]
