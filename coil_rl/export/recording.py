"""Observations of an env with the actions of a controller, to compare an exported policy with.

They come from the env itself, driven by the controller, so that they are what a machine will see:
random numbers would never be two boundaries of a track. In every second episode some actions are
drawn, so that the observations are not only those of a perfect drive.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coil_rl.export.step import ADVICE
from coil_rl.run.controller import Controller
from coil_rl.run.parts import TRAIN, transformed
from coil_rl.run.run import Run
from coil_rl.transforms.action_space import ActionSpace, random_action

LONGEST = 250  # steps of an episode
DRAWN = 0.3  # share of drawn actions in every second episode


@dataclass
class Recording:
    """Steps of a controller.

    Attributes:
        entries: of the env, [1] each; with guides also `guide_action`, [1, n_guides, ...], what
            they advised, see `PolicyStep`.
        first: whether the step begins an episode.
        actions: of the controller, as entries of the env, [1, *A] each.
        seconds: that the controller took.
    """

    entries: list[TensorDictBase] = field(default_factory=list)
    first: list[bool] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)
    seconds: float = 0.0

    def __len__(self) -> int:
        return len(self.entries)


@torch.no_grad()
def record(
    run: Run,
    controller: Controller,
    count: int,
    seed: int = 0,
    tick: Callable[[], Any] = lambda: None,
) -> Recording:
    """Drive the env of a run by a controller, and return what was seen and done.

    Args:
        count: number of steps.
        seed: of the env and of the drawn actions.
        tick: called after every step.
    """
    bare = run.make_env.of_agent or run.make_env.bare
    env = transformed(bare(1, TRAIN, None), [], "env").eval()
    env.set_seed(seed)
    keys = [*env.base_env.observation_spec.keys()]
    recording, heard = Recording(), Heard(controller)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        episode = -1
        while True:
            episode, carrier = episode + 1, env.reset()
            controller.reset()
            for step in range(LONGEST):
                if len(recording) == count:
                    heard.close()
                    return recording
                entries = carrier.select(*keys)
                copied, before = entries.clone(), time.process_time()
                action = controller.act_on(copied)
                recording.seconds += time.process_time() - before
                if heard.guides is not None:
                    entries[ADVICE] = heard.advice()
                recording.entries.append(entries)
                recording.first.append(step == 0)
                recording.actions.append(action.clone())
                executed = carrier.set(env.action_key, action)
                if episode % 2 and float(torch.rand(())) < DRAWN:
                    executed = random_action(env, carrier)
                after = env.step(executed)
                carrier = env.step_mdp(after)
                tick()
                if after["next", "done"].any():
                    break


class Heard:
    """Listens to the guides of a controller.

    Args:
        controller: the controller.
    """

    def __init__(self, controller: Controller) -> None:
        self.guides = controller.guides
        self.actions: dict[str, Tensor] = {}
        guides = {} if self.guides is None else self.guides.guides.guides
        self.hooks = [
            guide.register_forward_hook(partial(self._listen, name))
            for name, guide in guides.items()
        ]

    def _listen(self, name: str, module: Any, arguments: Any, written: TensorDictBase) -> None:
        if self.guides is not None:
            self.actions[name] = written[self.guides.action_key].clone()

    def advice(self) -> Tensor:
        """Return the last actions of all guides in the unit and numbering of the env."""
        if self.guides is None:
            return torch.empty(0)
        space: ActionSpace = self.guides.guide_space
        own = [self.actions[name] for name in self.guides.names]
        vectors = [space.advice(action, action.shape[:1]) for action in own]
        return torch.stack([numbered(space, each) for each in vectors], -2)

    def close(self) -> None:
        """Listen no longer."""
        for hook in self.hooks:
            hook.remove()


def numbered(space: ActionSpace, vectors: Tensor) -> Tensor:
    """Return vectors [..., A] in the numbering of the env: of choices [..., n] whole numbers.

    Args:
        vectors: as `ActionSpace` has them.
    """
    if not space.choices:
        return vectors
    chosen = torch.stack([part.argmax(-1) for part in vectors.split(space.choices, -1)], -1)
    return chosen if space.first is None else chosen + space.first.to(chosen)
