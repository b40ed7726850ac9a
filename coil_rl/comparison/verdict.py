"""The recommendation of a comparison: the rule, and three sentences.

The rule is simple. What costs nothing wins, unless something is clearly better:

1. Where nothing is clearly better than random actions, nothing is recommended. Otherwise only what
   is clearly better than these is recommended.
2. The guide is the wrong way round where its opposite is clearly better, by a tenth of the scale.
   Then the opposite takes its place.
3. A tuned guide takes the place of the guide where it is clearly better.
4. Of what learned and is clearly better than that guide, the best is recommended.
5. The neutral action, or the untrained policy, is recommended where it is clearly better than that.

To train to the end it is always anchored COIL, with SAC where actions are numbers, unless numbers
of the guide are to be tuned: in 40 comparisons the arm that led here was no better choice.

What is not clearly better than random actions loses its place to anything that is.

The scale is the distance from random actions to the best mean. *Clearly* is: the 95 % interval of
the paired differences over the cases, of the means over seeds, is above 0; the difference is above
0 for each seed; and it is at least 1 % of the scale. A single case has no interval, so that nothing
is clear. Two seeds are few: the interval is about other cases for these trainings, and says nothing
about other trainings.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from coil_rl.comparison import sentences
from coil_rl.comparison.arms import ANCHORED, ANCHORED_SAC, GUIDE, OPPOSITE, RANDOM, TUNE
from coil_rl.comparison.entry import IDLE, Entry, difference

MATERIAL = 0.01  # of the scale
REVERSED = 0.1  # of the scale, by which the opposite of a guide must be better
NOTHING = "nothing"


@dataclass(frozen=True)
class Verdict:
    """What to use, and why.

    Args:
        use: name of an entry, or `NOTHING`.
        train: name of the arm for a whole training; empty where it has no results.
        score: of the guide: 0 for random actions, 1 for the best.
        score_of_use: of what to use.
        wrong_way_round: whether the opposite of the guide is clearly better than the guide.
        sentences: what to use; what it gained; what is undecided.
    """

    use: str
    train: str
    score: float
    score_of_use: float
    wrong_way_round: bool
    sentences: Sequence[str] = field(default_factory=tuple)

    def to_dict(self, command: str) -> dict[str, Any]:
        """Return the verdict as a dictionary that JSON can hold: missing scores are None.

        Args:
            command: that trains to the end what is recommended.
        """
        values = asdict(self) | {"command": command}
        scores = {key: values[key] for key in ("score", "score_of_use")}
        return values | {key: None if math.isnan(each) else each for key, each in scores.items()}


def verdict(entries: Mapping[str, Entry], failed: Sequence[str] = ()) -> Verdict:
    """Return the recommendation.

    Args:
        entries: by name; guide, opposite, zero and random are among them.
        failed: names of arms that have no results.
    """
    guide, random = entries[GUIDE], entries[RANDOM]
    others = [each for each in entries.values() if each is not random]
    best = max(others, key=_mean)
    scale = best.mean - random.mean
    sure = {each.name for each in others if difference(each, random).above(0)}
    train = next((name for name in (ANCHORED_SAC, ANCHORED) if name in entries), "")
    if not sure:
        return Verdict(NOTHING, train, math.nan, math.nan, False, sentences.nothing(best, entries))
    use, kept = _chosen(entries, sure, scale)
    score = (guide.mean - random.mean) / scale
    wrong = difference(entries[OPPOSITE], guide).above(REVERSED * scale)
    if use.name == TUNE:
        train = TUNE
    said = sentences.what(use, kept, entries, score, wrong)
    said += sentences.gained(use, entries)
    said += sentences.undecided(use, others, MATERIAL * scale, failed)
    reached = (use.mean - random.mean) / scale
    return Verdict(use.name, train, score, reached, wrong, said)


def _mean(entry: Entry) -> float:
    return entry.mean


def _chosen(
    entries: Mapping[str, Entry], sure: Collection[str], scale: float
) -> tuple[Entry, Entry]:
    """Return what is recommended, and what is without neutral action and untrained policy.

    Args:
        entries: by name.
        sure: names of those that are clearly better than random actions, at least one.
        scale: from random actions to the best mean.
    """
    least = MATERIAL * scale
    tuned = [each for each in entries.values() if each.name == TUNE]
    learned = [each for each in entries.values() if each.learns]
    idle = [each for each in entries.values() if each.name in IDLE]
    use = _replaced(entries[GUIDE], [entries[OPPOSITE]], sure, REVERSED * scale)
    use = _replaced(use, tuned, sure, least)
    use = _replaced(use, learned, sure, least)
    return _replaced(use, idle, sure, least), use


def _replaced(use: Entry, others: Sequence[Entry], sure: Collection[str], least: float) -> Entry:
    """Return the best of those that may take the place of an entry; without one, that entry.

    Args:
        others: that may take its place if they are clearly better.
        sure: names of what is clearly better than random actions. Without being among them the
            entry loses its place to any other that is.
        least: difference from which another one is better.
    """
    able = [each for each in others if each.name in sure]
    if use.name in sure:
        able = [each for each in able if difference(each, use).above(least)]
    return max(able, key=_mean, default=use)
