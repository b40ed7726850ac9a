"""The values of the three sentences of a comparison, whose words are in `compare.j2`."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from coil_rl.comparison.arms import GUIDE, OPPOSITE, PPO, RANDOM, TUNE, ZERO
from coil_rl.comparison.entry import IDLE, ZERO_ACTIONS, Entry, difference
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format

SENTENCES = Sentences("coil_rl.comparison", "compare.j2")
AT_BEST = 0.99  # of the scale: a guide that may be left as it is


def nothing(best: Entry, entries: Mapping[str, Entry]) -> list[str]:
    """Return the sentences where nothing is better than random actions."""
    found = difference(best, entries[RANDOM])
    return SENTENCES.said(
        "nothing",
        best=best,
        found=found,
        trained=any(each.trained for each in entries.values()),
        one_case=math.isnan(found.low),
        **{name: entries[name] for name in (GUIDE, OPPOSITE, ZERO, RANDOM)},
    )


def what(use: Entry, entries: Mapping[str, Entry], score: float, wrong: bool) -> list[str]:
    """Return the sentence that says which guide or policy to use."""
    guide, random = entries[GUIDE], entries[RANDOM]
    if use.name == GUIDE:
        return SENTENCES.said("keep", guide=guide, score=score, is_best=score >= AT_BEST)
    return SENTENCES.said(
        "use",
        kind=use.name if use.name in (OPPOSITE, TUNE) else "learned",
        use=use,
        guide=guide,
        random=random,
        wrong=wrong,
        clear=difference(guide, random).above(0),
        share=_share(guide, use, random),
    )


def idle(use: Entry, kept: Entry, entries: Mapping[str, Entry]) -> list[str]:
    """Return the sentence where the neutral action or the untrained policy is clearly better.

    Args:
        use: the neutral action or the untrained policy.
        kept: what to use without them.
        entries: by name.
    """
    guide, random = entries[GUIDE], entries[RANDOM]
    others = [each for each in entries.values() if each is not use]
    close = [each.name for each in others if not difference(use, each).above(0)]
    return SENTENCES.said(
        "idle",
        use=use,
        is_zero=use.name == ZERO,
        is_nothing=use.action == ZERO_ACTIONS,
        kept=kept,
        kept_clear=difference(kept, random).above(0),
        close=close if set(close) <= set(IDLE) else None,
        guide=guide,
        random=random,
        share=_share(guide, use, random),
    )


def _share(entry: Entry, other: Entry, random: Entry) -> float:
    """Return the distance of an entry from random actions as a share of that of another one."""
    whole = other.mean - random.mean
    return (entry.mean - random.mean) / whole if whole else math.nan


def gained(use: Entry, entries: Mapping[str, Entry]) -> list[str]:
    """Return the sentence that says what was gained over the guide and over PPO."""
    against = {GUIDE: "the guide", PPO: "PPO"}
    others = [name for name in against if name in entries and name != use.name]
    parts = [(difference(use, entries[name]), against[name]) for name in others]
    return SENTENCES.said("gained", parts=parts, cases=use.returns.shape[1])


def undecided(
    use: Entry, entries: Sequence[Entry], least: float, failed: Sequence[str]
) -> list[str]:
    """Return the sentence that says what is undecided, of all entries but random actions."""
    others = [each for each in entries if each is not use]
    widest = max(entries, key=_between_seeds)
    spread = _between_seeds(widest)
    return SENTENCES.said(
        "undecided",
        close=_listed([each.name for each in others if not difference(use, each).above(least)]),
        rising=_listed([each.name for each in entries if each.rising]),
        failed=_listed(failed),
        trained=any(each.trained for each in entries),
        widest=widest.name if len(widest.returns) > 1 else "",
        seeds=len(widest.returns),
        spread=format(spread, return_format([spread])),
    )


def _between_seeds(entry: Entry) -> float:
    """Return the difference between the best and the worst mean of a seed; -1 for one seed."""
    return float(np.ptp(entry.returns.mean(1))) if len(entry.returns) > 1 else -1.0


def _listed(names: Sequence[str]) -> str:
    """Return names as in a sentence."""
    return " or ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
