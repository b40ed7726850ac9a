"""Comparison of an exported policy with the controller, observation by observation.

Differences are in normalised actions, so that 1 is half of the range of a number; another choice
counts as 1. They may be at most `LIMIT`, with a guide inside `WITH_GUIDE`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coil_rl.export.files import names_of
from coil_rl.export.recording import Recording
from coil_rl.export.session import Session
from coil_rl.export.step import NotExportableError, PolicyStep

LIMIT, WITH_GUIDE = 1e-5, 2e-5


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


def compare(
    step: PolicyStep,
    content: bytes,
    recording: Recording,
    limit: float,
    tick: Callable[[], Any] = lambda: None,
) -> Parity:
    """Return how much a file differs from the controller.

    Args:
        step: the function that the file holds.
        content: of the file.
        recording: of the controller.
        limit: allowed difference.
        tick: called after every step.

    Raises:
        NotExportableError: if it differs by too much.
    """
    session = Session(content, names_of(step)[1])
    own = step.space.executed(torch.cat(recording.actions))
    before = time.process_time()
    one_by_one, inputs = _called(step, session, recording, tick)
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
    return Parity(
        len(recording),
        largest,
        limit,
        1000 * seconds / len(recording),
        1000 * recording.seconds / len(recording),
    )


def _called(
    step: PolicyStep, session: Session, recording: Recording, tick: Callable[[], Any]
) -> tuple[Tensor, list[dict[str, Any]]]:
    """Return the actions of a file that is called step by step, [N, *A], and what it was given."""
    actions, given, state = list[Tensor](), list[dict[str, Any]](), dict[str, Any]()
    for number in range(len(recording)):
        if recording.first[number]:
            state = {f"state.{entry.name}": entry.rows(1).numpy() for entry in step.state}
        inputs = {entry.name: recording.entries[number][entry.key].numpy() for entry in step.inputs}
        given.append(inputs | state)
        action, *after = session(given[-1])
        state = dict(zip(state, after, strict=True))
        actions.append(torch.from_numpy(action))
        tick()
    return torch.cat(actions), given


def _difference(step: PolicyStep, actions: Tensor, others: Tensor) -> Tensor:
    """Return the largest difference in each row of two batches of actions, [B]."""
    units = step.space.units
    if units is None:
        return (actions != others).reshape(len(actions), -1).any(-1).float()
    apart = (units.normalise(actions) - units.normalise(others)).abs()
    return torch.nan_to_num(apart.flatten(1).amax(-1), nan=np.inf).float()
