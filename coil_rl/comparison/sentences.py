"""The three sentences of a comparison: what to use; what it gained; what is undecided."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from coil_rl.comparison.arms import GUIDE, OPPOSITE, PPO, RANDOM, TUNE, ZERO
from coil_rl.comparison.entry import IDLE, ZERO_ACTIONS, Entry, difference
from coil_rl.report.table import return_format

AT_BEST = 0.99  # of the scale: a guide that may be left as it is


def nothing(best: Entry, entries: Mapping[str, Entry]) -> tuple[str, ...]:
    """Return the sentences where nothing is better than random actions."""
    random = entries[RANDOM]
    found = difference(best, random)
    named = {name: entries[name].shown for name in (GUIDE, OPPOSITE, ZERO)}
    learned, remedy = "nor what was learned in this time", "give more time (minutes=20)"
    if not any(each.trained for each in entries.values()):
        learned = "and no training finished"
        remedy = "correct what made the trainings fail"
    elif math.isnan(found.low):
        remedy = "give more cases than one"
    return (
        f"Nothing here is clearly better than random actions ({random.shown}): neither the guide "
        f"({named[GUIDE]}), nor its opposite ({named[OPPOSITE]}), nor "
        f"{entries[ZERO].action} ({named[ZERO]}), {learned}.",
        f"The best is {best.name} with {best.shown}, {found} against random actions.",
        f"Undecided is everything: {remedy}, or look at the reward and at the guide.",
    )


def what(use: Entry, entries: Mapping[str, Entry], score: float, wrong: bool) -> str:
    """Return the sentence that says which guide or policy to use."""
    guide, random = entries[GUIDE], entries[RANDOM]
    start = ""
    if wrong:
        start = "Your guide is the wrong way round. "
    elif not difference(guide, random).above(0):
        start = f"Your guide is not clearly better than random actions ({random.shown}). "
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
    share = _share(guide, use, random)
    return f"{start}Use {use.name}: {use.shown} (guide {guide.shown}, at {share:.2f} of it)."


def idle(use: Entry, kept: Entry, entries: Mapping[str, Entry]) -> str:
    """Return the sentence where the neutral action or the untrained policy is clearly better.

    Args:
        use: the neutral action or the untrained policy.
        kept: what to use without them.
        entries: by name.
    """
    guide, random = entries[GUIDE], entries[RANDOM]
    others = [each for each in entries.values() if each is not use]
    than = f"{kept.name} ({kept.shown}), the best choice without it"
    close = [each.name for each in others if not difference(use, each).above(0)]
    if set(close) <= set(IDLE):
        than = " but ".join(["everything else here", *close])
    elif not difference(kept, random).above(0):
        than = f"random actions ({random.shown}), which no guide and no trained policy here is"
    return (
        f"{_idle_words(use)}, {use.shown}) is clearly better than {than}; your guide has "
        f"{guide.shown}, at {_share(guide, use, random):.2f} of it."
    )


def _idle_words(use: Entry) -> str:
    """Return the beginning of `idle`: what is used, and in brackets what it is."""
    if use.name != ZERO:
        return f"The untrained policy ({use.name}"
    if use.action == ZERO_ACTIONS:
        return f"Doing nothing ({use.action}"
    return f"{use.action.capitalize()} ({use.name}"


def _share(entry: Entry, other: Entry, random: Entry) -> float:
    """Return the distance of an entry from random actions as a share of that of another one."""
    return (entry.mean - random.mean) / (other.mean - random.mean)


def gained(use: Entry, entries: Mapping[str, Entry]) -> str:
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


def undecided(use: Entry, entries: Sequence[Entry], least: float, failed: Sequence[str]) -> str:
    """Return the sentence that says what is undecided, of all entries but random actions."""
    others = [each for each in entries if each is not use]
    close = [each.name for each in others if not difference(use, each).above(least)]
    rising = [each.name for each in entries if each.rising]
    parts = []
    if close:
        parts.append(f"whether {_listed(close)} would be as good or better")
    if rising:
        parts.append(f"where {_listed(rising)} would end, still rising")
    if failed:
        parts.append(f"what {_listed(failed)} would have reached, which failed")
    several = [each for each in entries if len(each.returns) > 1]
    few = "Each training ran once, which says nothing about another seed."
    if not any(each.trained for each in entries):
        few = "No training finished."
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
