"""The episodes of the guides in the table of a run, which are driven once and kept.

A guide may take milliseconds for an action, and a run that was stopped in its evaluation, or that
is to write its table again, would ask it for all of them once more. Like the guide's line of the
evaluation curve they are a file of the run.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.files import LARGEST_TABLE, read_file, write_text
from coil_rl.run.evaluation import EvaluationResult

GUIDE_EPISODES = "guide_episodes.json"
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
    file = folder / GUIDE_EPISODES
    try:
        saved = json.loads(read_file(file, LARGEST_TABLE))
        if saved["key"] == key:
            return {str(name): _result(each) for name, each in saved["guides"].items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        pass  # they are driven
    results = drive()
    if results and _numbers(results) <= MOST_NUMBERS:
        guides = {name: _plain(result) for name, result in results.items()}
        write_text(file, json.dumps({"key": key, "guides": guides}))
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


def _plain(result: EvaluationResult) -> dict[str, Any]:
    """Return a result as values of JSON, which keep every digit."""
    histories = {
        name: [history.tolist() for history in each] for name, each in result.histories.items()
    }
    return {"rate": result.rate, "episodes": result.episodes, "histories": histories}


def _result(plain: Mapping[str, Any]) -> EvaluationResult:
    """Return the result of values of JSON; raises an error for others."""
    histories = {
        str(name): [np.array(history, dtype=np.float64) for history in each]
        for name, each in plain["histories"].items()
    }
    episodes: Sequence[Mapping[str, Any]] = plain["episodes"]
    for episode in episodes:
        float(episode["reward"]), int(episode["steps"]), str(episode["case"])
    return EvaluationResult([dict(episode) for episode in episodes], histories, plain["rate"])
