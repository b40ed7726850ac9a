"""The three sentences of a comparison: what to use; what it gained; what is undecided."""

from collections.abc import Mapping, Sequence

import numpy as np

from coil_rl.comparison.arms import GUIDE, PPO, RANDOM
from coil_rl.comparison.entry import IDLE, ZERO_ACTIONS, Entry, difference
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format

COMPARE = Sentences("coil_rl.comparison", "compare.j2")
AT_BEST = 0.99  # of the scale: a guide that may be left as it is


def nothing(best: Entry, entries: Mapping[str, Entry]) -> list[str]:
    """Return the sentences where nothing is better than random actions."""
    found = difference(best, entries[RANDOM])
    finished = any(each.trained for each in entries.values())
    return COMPARE.said("nothing", entries=entries, best=best, found=found, finished=finished)


def what(
    use: Entry, kept: Entry, entries: Mapping[str, Entry], score: float, wrong: bool
) -> list[str]:
    """Return the sentence that says which guide or policy to use.

    Args:
        use: what is recommended.
        kept: what would be without neutral action and untrained policy.
        entries: by name.
        score: of the guide.
        wrong: whether the guide is the wrong way round.
    """
    guide, random = entries[GUIDE], entries[RANDOM]
    values = {"use": use, "entries": entries}
    if use.name not in IDLE:
        clear, share = difference(guide, random).above(0), _share(guide, use, random)
        values |= {"score": score, "at_best": AT_BEST, "wrong": wrong}
        return COMPARE.said("what", **values, clear=clear, share=share)
    others = [each for each in entries.values() if each is not use]
    close = [each.name for each in others if not difference(use, each).above(0)]
    return COMPARE.said(
        "idle",
        **values,
        kept=kept,
        zero_actions=ZERO_ACTIONS,
        close=close,
        alone=set(close) <= set(IDLE),
        clear=difference(kept, random).above(0),
        share=_share(guide, use, random),
    )


def _share(entry: Entry, other: Entry, random: Entry) -> float:
    """Return the distance of an entry from random actions as a share of that of another one."""
    return (entry.mean - random.mean) / (other.mean - random.mean)


def gained(use: Entry, entries: Mapping[str, Entry]) -> list[str]:
    """Return the sentence that says what was gained over the guide and over PPO."""
    titles = {GUIDE: "the guide", PPO: "PPO"}
    found = {
        title: difference(use, entries[name])
        for name, title in titles.items()
        if name in entries and name != use.name
    }
    return COMPARE.said("gained", found=found, cases=use.returns.shape[1])


def undecided(
    use: Entry, entries: Sequence[Entry], least: float, failed: Sequence[str]
) -> list[str]:
    """Return the sentence that says what is undecided, of all entries but random actions."""
    others = [each for each in entries if each is not use]
    several = [each for each in entries if len(each.returns) > 1]
    widest = max(several, key=_between_seeds, default=None)
    spread = 0.0 if widest is None else _between_seeds(widest)
    return COMPARE.said(
        "undecided",
        close=_listed([each.name for each in others if not difference(use, each).above(least)]),
        rising=_listed([each.name for each in entries if each.rising]),
        failed=_listed(failed),
        widest=widest,
        spread=format(spread, return_format([spread])),
        finished=any(each.trained for each in entries),
    )


def _between_seeds(entry: Entry) -> float:
    """Return the difference between the best and the worst mean of a seed."""
    return float(np.ptp(entry.returns.mean(1)))


def _listed(names: Sequence[str]) -> str:
    """Return names as in a sentence; empty for none."""
    return " or ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
