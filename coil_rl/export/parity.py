"""Comparison of an exported policy with the controller, observation by observation.

The observations come from the env itself, driven by the controller, so that they are what a machine
will see: random numbers would never be two boundaries of a track. In every second episode some
actions are drawn, so that they are not only those of a perfect drive.

Differences are in normalised actions, so that 1 is half of the range of a number; another choice
counts as 1. They may be at most `LIMIT`, with a guide inside `WITH_GUIDE`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coil_rl.export.contract import ADVICE
from coil_rl.export.files import names_of
from coil_rl.export.session import Session
from coil_rl.export.step import NotExportableError, PolicyStep
from coil_rl.run.controller import Controller
from coil_rl.run.parts import TRAIN, transformed
from coil_rl.run.run import Run
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace, random_action

LIMIT, WITH_GUIDE = 1e-5, 2e-5
LONGEST = 250  # steps of an episode
DRAWN = 0.3  # share of drawn actions in every second episode


class Step(NamedTuple):
    """A step of a controller in an env.

    Attributes:
        entries: of the env, [1]; with guides also `guide_action`, [1, n_guides, ...], what they
            advised, see `PolicyStep`.
        first: whether it begins an episode.
        action: of the controller, as an entry of the env, [1, *A].
        seconds: that the controller took.
    """

    entries: TensorDictBase
    first: bool
    action: Tensor
    seconds: float


@dataclass(frozen=True)
class Parity:
    """How much an exported policy differs from the controller.

    Attributes:
        observations: number of compared steps.
        largest: largest difference, in normalised actions.
        limit: allowed difference.
        milliseconds: CPU time of a call of the file.
        torch_milliseconds: CPU time of a call of the controller.
    """

    observations: int
    largest: float
    limit: float
    milliseconds: float
    torch_milliseconds: float

    def __str__(self) -> str:
        return (
            f"the file differs from torch by at most {self.largest:.1e} on {self.observations:,} "
            f"observations (limit {self.limit:.0e}); {self.milliseconds:.2f} ms of CPU a "
            f"call, torch takes {self.torch_milliseconds:.2f} ms"
        )


@torch.no_grad()
def record(
    run: Run, controller: Controller, count: int, seed: int, tick: Callable[[], Any]
) -> list[Step]:
    """Drive the env of a run by a controller, and return what was seen and done.

    Args:
        count: number of steps.
        seed: of the env and of the drawn actions.
        tick: called after every step.
    """
    bare = run.make_env.of_agent or run.make_env.bare
    env = transformed(bare(1, TRAIN, None), [], "env").eval()
    env.set_seed(seed)
    steps = list[Step]()
    if controller.guides is not None:
        controller.guides.heard = {}
    episode, age, done = -1, 0, True
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(count):
            if done or age == LONGEST:
                carrier, episode, age = env.reset(), episode + 1, 0
                controller.reset()
            entries = carrier.select(*env.base_env.observation_spec.keys())
            copied, before = entries.clone(), time.process_time()
            action = controller.act_on(copied)
            seconds = time.process_time() - before
            if controller.guides is not None:
                entries[ADVICE] = heard(controller.guides)
            steps.append(Step(entries, age == 0, action.clone(), seconds))
            carrier.set(env.action_key, action)
            if episode % 2 and float(torch.rand(())) < DRAWN:
                carrier = random_action(env, carrier)
            after = env.step(carrier)
            carrier, age, done = env.step_mdp(after), age + 1, bool(after["next", "done"].any())
            tick()
    if controller.guides is not None:
        controller.guides.heard = None
    return steps


def heard(guides: GuideActions) -> Tensor:
    """Return the last actions of all guides in the unit and numbering of the env.

    Args:
        guides: whose `heard` was not None.
    """
    vectors = [(guides.heard or {})[name] for name in guides.names]
    return torch.stack([numbered(guides.guide_space, each) for each in vectors], -2)


def numbered(space: ActionSpace, vectors: Tensor) -> Tensor:
    """Return vectors [..., A] in the numbering of the env: of choices [..., n] whole numbers.

    Args:
        vectors: as `ActionSpace` has them.
    """
    if not space.choices:
        return vectors
    chosen = torch.stack([part.argmax(-1) for part in vectors.split(space.choices, -1)], -1)
    return chosen if space.first is None else chosen + space.first.to(chosen)


def compare(step: PolicyStep, content: bytes, recorded: list[Step], limit: float) -> Parity:
    """Return how much a file differs from the controller.

    Args:
        step: the function that the file holds.
        content: of the file.
        recorded: steps of the controller.
        limit: allowed difference.

    Raises:
        NotExportableError: if it differs by too much.
    """
    session = Session(content, names_of(step)[1])
    own = step.space.executed(torch.cat([each.action for each in recorded]))
    before = time.process_time()
    one_by_one, inputs = _called(step, session, recorded)
    seconds = time.process_time() - before
    # All rows at once, as a batch of envs calls it.
    batch = {name: np.concatenate([each[name] for each in inputs]) for name in inputs[0]}
    at_once = torch.from_numpy(session(batch)[0])
    differences = torch.maximum(_difference(step, one_by_one, own), _difference(step, at_once, own))
    worst = int(differences.argmax())
    largest = float(differences[worst])
    if not largest <= limit:
        raise NotExportableError(
            f"its action differs by {largest:.1e} at observation {worst + 1}, but must by at most "
            f"{limit:.0e}: it depends on more than its inputs and its memory"
        )
    count, of_torch = len(recorded), sum(each.seconds for each in recorded)
    return Parity(count, largest, limit, 1000 * seconds / count, 1000 * of_torch / count)


def _called(
    step: PolicyStep, session: Session, recorded: list[Step]
) -> tuple[Tensor, list[dict[str, Any]]]:
    """Return the actions of a file that is called step by step, [N, *A], and what it was given."""
    actions, given, state = list[Tensor](), list[dict[str, Any]](), dict[str, Any]()
    for each in recorded:
        if each.first:
            state = {f"state.{entry.name}": entry.rows(1).numpy() for entry in step.state}
        inputs = {entry.name: each.entries[entry.key].numpy() for entry in step.inputs}
        given.append(inputs | state)
        action, *after = session(given[-1])
        state = dict(zip(state, after, strict=True))
        actions.append(torch.from_numpy(action))
    return torch.cat(actions), given


def _difference(step: PolicyStep, actions: Tensor, others: Tensor) -> Tensor:
    """Return the largest difference in each row of two batches of actions, [B]."""
    units = step.space.units
    if units is None:
        return (actions != others).reshape(len(actions), -1).any(-1).float()
    apart = (units.normalise(actions) - units.normalise(others)).abs()
    return torch.nan_to_num(apart.flatten(1).amax(-1), nan=np.inf).float()
