"""Rewards as fractions of the guide's in the same case, as in the paper's table 5."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coil_rl import Measure, UserError
from coil_rl.report import Comparison, Group

NEXT_TO_NOTHING = 0.01  # of a guide's mean reward over its other cases: too little to divide by
EARNED = "earned"  # measure of a group with fractions: the reward itself
HEADING, SPEC = "reward / guide's", ".3f"  # of the fractions

References = Mapping[tuple[str, ...], np.ndarray]


def relative(comparison: Comparison) -> Comparison:
    """Return a comparison whose rewards are fractions of the best guide's in the same case.

    The rewards themselves are the measure `EARNED`.

    Raises:
        UserError: where a policy has cases in which no guide has rewards to divide by.
    """
    references: dict[tuple[str, ...], np.ndarray] = {}
    for guide in comparison.guides:  # the best first
        reference = _reference(guide)
        if reference is not None:
            references.setdefault(guide.cases, reference)
    for group in comparison.groups:
        if group.cases not in references:
            raise UserError(
                f"the rewards of {group.name} are to be given as fractions of a guide's, but no "
                "guide earns anything in the same cases; evaluate one that does"
            )
    guides = {group: _divided(group, references) for group in comparison.guides}
    agents = [_divided(group, references) for group in comparison.agents]
    agents = [
        replace(each, guide=guides.get(each.guide)) if each.guide else each for each in agents
    ]
    return Comparison(tuple(guides.values()), tuple(agents))


def earned(group: Group) -> Group:
    """Return a group with its rewards themselves."""
    return replace(group, table=group.table.assign(reward=group.table[EARNED]))


def _divided(group: Group, references: References) -> Group:
    """Return a group with fractions of the reference in its cases."""
    reward = group.table["reward"]
    table = group.table.assign(
        **{"reward": reward / np.resize(references[group.cases], len(reward)), EARNED: reward}
    )
    return replace(
        group, table=table, measures={**group.measures, EARNED: Measure("reward", "sum")}
    )


def _reference(guide: Group) -> np.ndarray | None:
    """Return the rewards of a guide to divide by, one for each case; None if it has none.

    In a case where it crashes, or earns nothing or next to nothing, its mean over the other cases
    is taken: the ratio to so small a reward would dominate the mean of all ratios. A guide has none
    if it earns nothing in every case.
    """
    rewards = guide.by_seed("reward").mean()
    earned = rewards[rewards > 0]
    if guide.has("crashed"):
        earned = earned[(guide.by_seed("crashed")[earned.index] == 0).all()]
    if len(earned) > 1:
        others = (earned.sum() - earned) / (len(earned) - 1)
        earned = earned[earned >= NEXT_TO_NOTHING * others]
    if not len(earned):
        return None
    return np.asarray(rewards.where(rewards.index.isin(earned.index), earned.mean()))
