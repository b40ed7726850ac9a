"""The recommendation of a comparison: the rule, and three sentences.

The rule is simple. What costs nothing wins, unless something is clearly better:

1. Where nothing is clearly better than random actions, nothing is recommended.
2. The guide is the wrong way round where its opposite is clearly better, by a tenth of the scale.
   Then the opposite takes its place.
3. A tuned guide takes the place of the guide where it is clearly better.
4. The best of what learned is recommended where it is clearly better than that guide.

The scale is the distance from random actions to the best mean. *Clearly* is: the 95 % interval of
the paired differences over the cases, of the means over seeds, is above 0; the difference is above
0 for each seed; and it is at least 1 % of the scale. Two seeds are few: the interval is about other
cases for these trainings, and says nothing about other trainings.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.report.statistics import mean_interval
from coil_rl.report.table import return_format
from coil_rl.worth.arms import GUIDE, NETWORK, OPPOSITE, PPO, RANDOM, TUNE, ZERO

MATERIAL = 0.01  # of the scale
REVERSED = 0.1  # of the scale, by which the opposite of a guide must be better
AT_BEST = 0.99  # of the scale: a guide that may be left as it is
LEARNED = "learned"
NOTHING = "nothing"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Entry:
    """The results of what was compared.

    Args:
        name: of the policy or arm.
        returns: [seeds, cases]; one seed for what does not learn.
        rising: whether its learning curve was still rising at the end.
    """

    name: str
    returns: Array
    rising: bool = False

    @property
    def mean(self) -> float:
        """Mean return over seeds and cases."""
        return float(self.returns.mean())

    @property
    def shown(self) -> str:
        """The mean as a text."""
        return format(self.mean, return_format([self.mean]))

    @property
    def learns(self) -> bool:
        """Whether it is the policy of a training."""
        return self.name not in (GUIDE, OPPOSITE, ZERO, RANDOM, NETWORK, TUNE)


@dataclass(frozen=True)
class Difference:
    """The paired difference of two entries in the same cases.

    Args:
        mean: of all cases and seeds.
        low: lower end of its 95 % t interval over the cases.
        high: upper end.
        seeds: means of each pair of seeds.
        spec: number format of the returns.
    """

    mean: float
    low: float
    high: float
    seeds: tuple[float, ...]
    spec: str = ".1f"

    def above(self, least: float) -> bool:
        """Return whether it is clearly above 0, and at least `least`."""
        return self.low > 0 and min(self.seeds) > 0 and self.mean >= least

    def __str__(self) -> str:
        mean, low, high = (f"{each:+{self.spec}}" for each in (self.mean, self.low, self.high))
        return f"{mean} ({low} to {high})"


def difference(one: Entry, other: Entry) -> Difference:
    """Return how much more one entry has than another in the same cases."""
    cases = one.returns.mean(0) - other.returns.mean(0)
    low = high = mean = float(cases.mean())
    if len(cases) > 1:
        mean, low, high = map(float, mean_interval(cases))
    of_seeds, of_others = one.returns.mean(1), other.returns.mean(1)
    if len(of_seeds) == len(of_others):
        seeds = of_seeds - of_others
    else:
        seeds = (of_seeds[:, None] - of_others[None, :]).ravel()
    spec = return_format([one.mean, other.mean])
    return Difference(mean, low, high, tuple(seeds.tolist()), spec)


@dataclass(frozen=True)
class Verdict:
    """What to use, and why.

    Args:
        use: name of an entry, or `NOTHING`.
        train: name of the arm that is worth a whole training; empty for none.
        score: of the guide: 0 for random actions, 1 for the best.
        wrong_way_round: whether the opposite of the guide is clearly better than the guide.
        sentences: what to use; what it gained; what is undecided.
    """

    use: str
    train: str
    score: float
    wrong_way_round: bool
    sentences: Sequence[str] = field(default_factory=tuple)

    def to_dict(self, command: str) -> dict[str, Any]:
        """Return the verdict as a dictionary that JSON can hold: a missing score is None.

        Args:
            command: that trains to the end what is recommended.
        """
        score = None if math.isnan(self.score) else self.score
        return asdict(self) | {"score": score, "command": command}


def verdict(entries: Mapping[str, Entry], failed: Sequence[str] = ()) -> Verdict:
    """Return the recommendation.

    Args:
        entries: by name; guide, opposite, zero and random are among them.
        failed: names of arms that have no results.
    """
    guide, random = entries[GUIDE], entries[RANDOM]
    candidates = [each for each in entries.values() if each.name not in (ZERO, RANDOM, NETWORK)]
    best = max(candidates, key=lambda entry: entry.mean)
    scale = best.mean - random.mean
    least = MATERIAL * scale
    learned = [each for each in candidates if each.learns]
    leading = max(learned, key=lambda entry: entry.mean, default=None)
    if not difference(best, random).above(0):
        train = leading.name if leading is not None else ""
        return Verdict(NOTHING, train, math.nan, False, _nothing(best, random, entries))
    score = (guide.mean - random.mean) / scale
    wrong = difference(entries[OPPOSITE], guide).above(REVERSED * scale)
    use = entries[OPPOSITE] if wrong else guide
    if TUNE in entries and difference(entries[TUNE], use).above(least):
        use = entries[TUNE]
    if leading is not None and difference(leading, use).above(least):
        use = leading
    train = "" if leading is None else leading.name
    if use.learns or use.name == TUNE:
        train = use.name
    sentences = (
        _what(use, guide, score, wrong),
        _gained(use, entries),
        _undecided(use, candidates, least, failed),
    )
    return Verdict(use.name, train, score, wrong, sentences)


def _nothing(best: Entry, random: Entry, entries: Mapping[str, Entry]) -> tuple[str, ...]:
    """Return the sentences where nothing is better than random actions."""
    found = difference(best, random)
    named = {name: entries[name].shown for name in (GUIDE, OPPOSITE)}
    return (
        f"Nothing here is clearly better than random actions ({random.shown}): neither the guide "
        f"({named[GUIDE]}), nor its opposite ({named[OPPOSITE]}), nor what was learned in this "
        "time.",
        f"The best is {best.name} with {best.shown}, {found} against random actions.",
        "Undecided is everything: give more time (minutes=20), or look at the reward and at the "
        "guide.",
    )


def _what(use: Entry, guide: Entry, score: float, wrong: bool) -> str:
    """Return the sentence that says what to use."""
    start = ""
    if wrong:
        start = "Your guide is the wrong way round. "
    if use.name == GUIDE and score >= AT_BEST:
        return f"Leave it: your guide is at {score:.2f} of what was reached ({guide.shown})."
    if use.name == GUIDE:
        return (
            f"Keep your guide ({guide.shown}): it is at {score:.2f} of what was reached, and "
            "nothing is clearly better."
        )
    if use.name == OPPOSITE:
        return (
            f"{start}Turn its action round: the opposite has {use.shown}, the guide {guide.shown}."
        )
    if use.name == TUNE:
        return (
            f"{start}Use your guide with the tuned numbers: {use.shown} instead of {guide.shown}."
        )
    return f"{start}Use {use.name}: {use.shown} (guide {guide.shown}, at {score:.2f} of it)."


def _gained(use: Entry, entries: Mapping[str, Entry]) -> str:
    """Return the sentence that says what was gained over the guide and over PPO."""
    against = [(name, entries[name]) for name in (GUIDE, PPO) if name in entries]
    parts = [
        f"{difference(use, other)} over {'the guide' if name == GUIDE else 'PPO'}"
        for name, other in against
        if use.name != name
    ]
    cases = use.returns.shape[1]
    if not parts:
        return "PPO has no results to compare with."
    return (
        f"It is {' and '.join(parts)} (mean of the differences in the same {cases} cases, 95 % "
        "interval over the cases)."
    )


def _undecided(use: Entry, candidates: Sequence[Entry], least: float, failed: Sequence[str]) -> str:
    """Return the sentence that says what is undecided."""
    others = [each for each in candidates if each is not use]
    close = [each.name for each in others if not difference(use, each).above(least)]
    rising = [each.name for each in candidates if each.rising]
    parts = []
    if close:
        parts.append(f"whether {_listed(close)} would be as good or better")
    if rising:
        parts.append(f"where {_listed(rising)} would end, still rising")
    if failed:
        parts.append(f"what {_listed(failed)} would have reached, which failed")
    several = [each for each in candidates if len(each.returns) > 1]
    few = "Each training ran once, which says nothing about another seed."
    if several:
        widest = max(several, key=_between_seeds)
        spread = _between_seeds(widest)
        few = (
            f"{len(widest.returns)} seeds say little about others: those of {widest.name} differ "
            f"by {spread:{return_format([spread])}}, the most here."
        )
    if not parts:
        return f"Undecided is what a whole training would change. {few}"
    return f"Undecided is {'; and '.join(parts)}. {few}"


def _between_seeds(entry: Entry) -> float:
    """Return the difference between the best and the worst mean of a seed."""
    return float(np.ptp(entry.returns.mean(1)))


def _listed(names: Sequence[str]) -> str:
    """Return names as in a sentence."""
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} or {names[-1]}"
