"""The episodes of the guides in the table of a run, which are driven once and kept.

A guide may take milliseconds for an action, and a run that was stopped in its evaluation, or that
is to write its table again, would ask it for all of them once more. Like the guide's line of the
evaluation curve they are a file of the run.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.errors import UserError
from coil_rl.record import GUIDE_EPISODES, Driven, Episode, GuideEpisodes
from coil_rl.run.evaluation import EvaluationResult

MOST_NUMBERS = 5_000_000  # of steps; more are not kept
# The values of a configuration that the episodes of guides depend on.
OF_GUIDES = ("env", "guide", "degrade", "evaluation", "track", "device")

Results = Mapping[str, EvaluationResult]


def driven_once(
    folder: Path, settings: Mapping[str, Any], evaluation: object, drive: Callable[[], Results]
) -> Results:
    """Return the episodes of the guides of a run, from its folder if they were driven before.

    A file that is damaged, or belongs to another configuration, is written anew.

    Args:
        folder: of the run.
        settings: its configuration.
        evaluation: cases and measures.
        drive: drives the guides; returns their episodes by name.
    """
    key = _key(settings, evaluation)
    try:
        saved = GUIDE_EPISODES.read(folder)
        if saved is not None and saved.key == key:
            return {name: _result(each) for name, each in saved.guides.items()}
    except (UserError, ValueError, TypeError):
        pass  # they are driven
    results = drive()
    if results and _numbers(results) <= MOST_NUMBERS:
        guides = {name: _driven(result) for name, result in results.items()}
        GUIDE_EPISODES.write(folder, GuideEpisodes(key=key, guides=guides))
    return results


def _key(settings: Mapping[str, Any], evaluation: object) -> str:
    """Return a text that is another one where the guides would drive other episodes."""
    values = {name: settings.get(name) for name in OF_GUIDES}
    text = json.dumps([values, repr(evaluation)], sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def _numbers(results: Results) -> int:
    """Return how many numbers the recorded steps have."""
    count = 0
    for result in results.values():
        for histories in result.histories.values():
            count += sum(history.size for history in histories)
    return count


def _driven(result: EvaluationResult) -> Driven:
    """Return a result as it is written, with every digit."""
    histories = {name: [each.tolist() for each in of] for name, of in result.histories.items()}
    episodes = [Episode(**episode) for episode in result.episodes]
    return Driven(rate=result.rate, episodes=episodes, histories=histories)


def _result(driven: Driven) -> EvaluationResult:
    """Return what was written as a result."""
    histories = {
        name: [np.array(history, dtype=np.float64) for history in each]
        for name, each in driven.histories.items()
    }
    return EvaluationResult([each.model_dump() for each in driven.episodes], histories, driven.rate)
