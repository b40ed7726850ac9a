"""Drives an agent over its tracks and measures in every state how much it listens to whom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.listening.measures import agreement, gradient, intervention
from coil_rl.listening.parts import ADVICE, Intercepted
from coil_rl.listening.places import Places
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace


@dataclass(frozen=True)
class Survey:
    """What was found in the N states of a drive, all cars of all tracks together.

    Attributes:
        guides: their names, one per slot of the advice.
        drive: how it went.
        track: [N], the car's track.
        point: [N], the point of that track's middle line where the car was.
        advice: [N, n_guides, A], what each guide said.
        measures: `agreement`, `intervention` and `gradient`, [N, n_guides] each.
    """

    guides: list[str]
    drive: EvaluationResult
    track: Tensor
    point: Tensor
    advice: Tensor
    measures: dict[str, Tensor]


def guide_names(env: EnvBase, policy: TensorDictModuleBase) -> list[str]:
    """What the slots of the advice are called: by the policy's own first module, or else by the env's transform.

    Raises:
        ValueError: if nobody gives advice by names.
    """
    advising = Intercepted(policy, lambda seen: seen).advising
    sources = [advising] if advising is not None else [m for m in env.modules() if isinstance(m, GuideActions)]
    if not sources:
        raise ValueError("nobody gives the policy its advice: put GuideActions into the env")
    return list(sources[0].names)


def survey(
    env: EnvBase,
    policy: TensorDictModuleBase,
    places: Places,
    *,
    donors: int = 16,
    seed: int = 0,
    names: Sequence[str] = (),
    tick: Callable[[], Any] | None = None,
) -> Survey:
    """Let the deterministic agent drive one episode with every car, and measure in every state it came to.

    Args:
        env: cars with `info`, [B].
        policy: the agent; reads `guide_action`.
        places: of the tracks of this env.
        donors: as for `intervention`.
        seed: of the draws of donors.
        names: of the tracks.
        tick: called every step.

    Raises:
        ValueError: if the policy does not read advice, or nobody writes it.
    """
    moments: list[TensorDictBase] = []

    def note(seen: TensorDictBase) -> TensorDictBase:
        moment = seen.select(*listener.acting.in_keys)
        moment["track"] = seen["info", "track"].squeeze(-1)
        moment["point"] = places.nearest(moment["track"], seen["info", "pose"][..., :2])
        moments.append(moment)
        return seen

    listener, guides = Intercepted(policy, note), guide_names(env, policy)
    driven = evaluate_policy(env, listener, names=names, tick=tick)
    steps = torch.tensor([episode["steps"] for episode in driven.episodes], device=env.device)
    running = torch.arange(len(moments), device=env.device).unsqueeze(-1) < steps
    states: TensorDictBase = torch.stack(moments)[running]
    space = ActionSpace(env.full_action_spec["action"], env.batch_dims)

    def act(asked: TensorDictBase) -> Tensor:
        return space.vectors(listener.acting(asked)["action"])

    generator = torch.Generator().manual_seed(seed)
    return Survey(
        guides=guides,
        drive=driven,
        track=states["track"],
        point=states["point"],
        advice=states[ADVICE],
        measures={
            "agreement": agreement(act, states),
            "intervention": intervention(act, states, donors, generator),
            "gradient": gradient(act, states),
        },
    )
